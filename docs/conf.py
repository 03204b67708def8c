"""How `bin/docs` builds the site. Sphinx imports the package to read its docstrings."""

from __future__ import annotations

import ast
import gc
import inspect
import re
import sys
from functools import partial
from importlib import metadata
from importlib.util import find_spec
from operator import attrgetter
from pathlib import Path
from pydoc import locate
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.errors import ExtensionError
from sphinx.util import inspect as sphinx_inspect

import proposer_rl  # noqa: F401  names of its modules are looked up in sys.modules

# What is imported and read stays: no need to look for garbage in it again and again.
gc.freeze()
gc.set_threshold(50_000, 20, 20)

project = "proposer_rl"
author = copyright = "proposer_rl contributors"
release = metadata.version(project)

extensions = [
    "myst_parser",  # pages in Markdown, which repository hosts show as well
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",  # a page for every module, without a list to keep
    "sphinx.ext.napoleon",  # docstrings in Google's style
]
exclude_patterns = ["_*"]
templates_path = ["_templates"]

# bin/docs fails on warnings: nothing unlinked, nothing linked that is not there.
nitpicky = True
nitpick_ignore = [  # stand-ins, see below
    ("py:class", "transformers.TrainerCallback"),
    ("py:class", "TensorDictBase"),  # of tensordict, in a text alone
    ("py:class", "DictConfig"),  # of OmegaConf, which is imported for type checks alone
    ("py:exc", "HydraException"),
]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

autosummary_ignore_module_all = True  # a name is documented where it is defined
autodoc_default_options = {"members": True, "show-inheritance": True, "ignore-module-all": True}
autodoc_member_order = "bysource"
autodoc_mock_imports = ["transformers"]  # which docs do without
autodoc_typehints_format = "short"
autodoc_use_type_comments = False  # every function's source would be parsed for them
maximum_signature_line_length = 88
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False

# Furo has all contents on every page, in which objects would take a quarter of the time.
toc_object_entries = False

html_theme = "furo"
html_title = f"{project} {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = html_show_sourcelink = html_show_sphinx = False
html_math_renderer = "mathml"


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    for page in Path(__file__).parent.glob(f"api/{project}.*.rst"):
        if find_spec(page.stem) is None:
            page.unlink()  # of a module that is gone
    app.add_html_math_renderer("mathml", (mathml, None), (mathml, None))
    app.connect("autodoc-process-docstring", prepare, priority=400)  # before napoleon
    app.connect("autodoc-process-signature", shorten)
    app.connect("autodoc-skip-member", skip_foreign)
    app.connect("doctree-read", forget_suffixes)
    app.connect("missing-reference", resolve)
    app.connect("source-read", unlink)


def unlink(app: Sphinx, page: str, content: list[str]) -> None:
    """Leaves links to Markdown outside of this folder to repository hosts: the site has none."""
    content[0] = re.sub(r"\[([^\]]+)\]\((?:\.\./){2}[^)]*\.md(?:#[^)]*)?\)", r"\1", content[0])


def mathml(translator: Any, node: nodes.math | nodes.math_block) -> None:
    """Writes an equation without JavaScript: it is there without a network, too."""
    block = isinstance(node, nodes.math_block)
    try:
        equation = tex2mathml(node.astext(), as_block=block)
    except MathError as error:
        raise ExtensionError(
            f"{translator.builder.current_docname}: {node.astext()}: {error}"
        ) from error
    translator.body.append(f'<div class="equation">{equation}</div>' if block else equation)
    raise nodes.SkipNode


def prepare(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Makes reStructuredText of what is none in a docstring."""
    if (
        what == "class" and lines and lines[0].startswith(f"{obj.__name__}(")
    ):  # TensorClass drops docstrings
        source = ast.parse(inspect.getsource(obj)).body[0]
        lines[:] = (ast.get_docstring(source) or "").splitlines()
    # The star of a shape such as [*B, 2] begins no emphasis, the bar of |d| no substitution.
    lines[:] = [
        line
        if line.lstrip().startswith((">>>", "..."))
        else re.sub(r"(``.*?``)|\*(?=[A-Z])|\|", lambda m: m[1] or "\\" + m[0], line)
        for line in lines
    ]
    # "height, width: of the grid" are two parameters.
    for i, line in reversed(list(enumerate(lines))):
        if found := re.fullmatch(r"    (\w+(?:, \w+)+)(: .*)", line):
            end = next((j for j in range(i + 1, len(lines)) if lines[j][:5].strip()), len(lines))
            lines[i:end] = [
                text
                for each in found[1].split(", ")
                for text in (f"    {each}{found[2]}", *lines[i + 1 : end])
            ]
    if what == "property":
        lines[:0] = ["..", ""]  # a comment; else "Seed: of all draws" were of the type Seed


def shorten(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, signature: str | None, returns: Any
) -> tuple[str | None, Any]:
    """Leaves the bounds of settings out; shows what an environment's metaclass hides."""
    if what == "class" and signature == "(*args, **kwargs)":
        init = sphinx_inspect.signature(obj.__init__, bound_method=True)
        signature = sphinx_inspect.stringify_signature(init, unqualified_typehints=True)
    return signature and re.sub(r"Annotated\[(\w+), [^\]]*\]", r"\1", signature), returns


def skip_foreign(
    app: Sphinx, what: str, name: str, obj: Any, skip: bool, options: Any
) -> bool | None:
    """Leaves out what a decorator or a NamedTuple adds to a class."""
    module = getattr(getattr(obj, "fget", obj), "__module__", None) or project
    added = not module.startswith(project) or str(obj.__doc__).startswith("Alias for field number")
    return added or None


def forget_suffixes(app: Sphinx, doctree: nodes.document) -> None:
    """Leaves names to :func:`resolve`: Sphinx would search all objects for one that ends so."""
    for node in doctree.findall(pending_xref):
        node.attributes.pop("refspecific", None)


def resolve(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, text: nodes.Element
) -> nodes.Element | None:
    """Links a name to what it means in the module whose docstring or annotation has it.

    What another package defines, or what has no docstring of its own, stays text. A name that means
    nothing there is that of the one object that ends so; else Sphinx warns.
    """
    target = re.sub(r"^pd\.", "pandas.", node["reftarget"])  # which only type checkers import
    if node["refdomain"] != "py":
        return None
    if not re.fullmatch(r"[\w.]+", target):
        return text  # an annotation that Sphinx could not take apart
    link = partial(env.domains.python_domain.resolve_xref, env, node["refdoc"], app.builder)
    found = meaning(target, node.get("py:module") or "")
    if found is None:
        node["refspecific"] = True  # the one object that ends so, if there is one
        return link(node["reftype"], target, node, text)
    defined = f"{getattr(found, '__module__', '')}.{getattr(found, '__qualname__', '')}"
    return link("obj", defined, node, text) or text


def meaning(target: str, module: str) -> Any:
    """What a dotted name is in a module, else in its package, in this one, or anywhere."""
    for start in (module, module.rpartition(".")[0], project):
        try:
            return attrgetter(target)(sys.modules[start])
        except (KeyError, AttributeError):
            continue
    return locate(target) or locate(target.partition(".")[0].replace(project, ""))

"""Tasks and curricula by name: what ``prl.tasks.maze()`` and ``prl.curricula.plr()`` return.

The names, their settings and the defaults are those of the files in ``conf/task`` and
``conf/method``, which the command line reads, too; so both sides of the library know the same.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, reduce
from inspect import isfunction
from pathlib import Path
from typing import Any, Literal

import yaml

PACKAGE = Path(__file__).resolve().parent
# In a wheel the configuration lies in the package, in a checkout beside it.
CONFIG_FOLDER = PACKAGE / "conf" if (PACKAGE / "conf").is_dir() else PACKAGE.parent / "conf"
KEY = re.compile(r"[A-Za-z_][A-Za-z0-9_]*([ -][A-Za-z_][A-Za-z0-9_]*)*")  # what Hydra takes
CONSTANTS = {"null", "true", "false", "nan", "inf"}
DEFAULT_METHOD = "adaptive_mixture"  # for those who do not want to choose
MISSING = "???"  # in a file: to be given
REFERENCE = re.compile(r"\$\{([\w.]+)\}")  # in a file: to another setting
KEYS = {"task": ("task",), "method": ("curriculum", "model")}
"""Below which keys of the configuration the settings of a group's files stand."""


@dataclass(frozen=True)
class Recipe:
    """A task or a curriculum that is made when a run begins.

    Attributes:
        group: ``"task"`` or ``"method"``.
        name: of a file in that folder of the configuration; or of a function of one's own.
        settings: that differ from the file's, by name; mappings are merged into those there.
        target: dotted name of one's own class or function; None for a file's.
    """

    group: Literal["task", "method"]
    name: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    target: str | None = None

    def overrides(self) -> list[str]:
        """Returns the same for the command line, without what is one's own."""
        if self.target is not None:
            # As most tasks call what is to be mastered; a headline that is given comes after it.
            return ["~task", "schedule.headline=target_success"] if self.group == "task" else []
        group = "task" if self.group == "task" else "+method"
        given = [
            override(f"++{key}.{name}", value)
            for key, settings in self.by_key().items()
            for name, value in settings.items()
        ]
        return [f"{group}={self.name}", *given]

    def by_key(self) -> dict[str, dict[str, Any]]:
        """Returns the settings by the key of the configuration that they stand below."""
        known = {self._key: {}} if self.target else _by_key(self.group, self.name)
        found: dict[str, dict[str, Any]] = {}
        for name, value in self.settings.items():
            key = next((key for key, there in known.items() if name in there), self._key)
            found.setdefault(key, {})[name] = value
        return found

    def own(self) -> dict[str, Any]:
        """Returns the configuration of one's own task or curriculum, which no file has."""
        if self.target is None:
            return {}
        named = {"method": self.name} if self.group == "method" else {}
        from proposer_rl.settings import plain  # which help does without

        return {**named, self._key: {"_target_": self.target, **plain(self.settings)}}

    @property
    def _key(self) -> str:
        return KEYS[self.group][0]


def own_recipe(
    group: Literal["task", "method"], make: Callable[..., Any], **settings: Any
) -> Recipe:
    """Returns a recipe for a class or function of one's own, which must be importable.

    Args:
        group: ``"task"``, or ``"method"`` for a curriculum.
        make: of a task, called with the settings, ``solver`` and ``context``; of a curriculum, with
            the run's :class:`~proposer_rl.methods.Components` and the settings.
        settings: numbers, texts, lists and mappings.

    Raises:
        ArgumentError: if it cannot be imported by its name.
    """
    return Recipe(group, make.__name__, settings, _dotted("make", make))


def _dotted(name: str, function: Any) -> str:
    dotted = f"{function.__module__}.{function.__qualname__}"
    if function.__module__ == "__main__" or "<" in dotted:
        raise _refusal(
            f"{name}={dotted}: must be importable, as a class or function of a module is, so that "
            "watch, eval and play can make it again"
        )
    return dotted


def available(group: str, folder: Path = CONFIG_FOLDER) -> list[str]:
    """Returns the names of a group's files, such as ``method``, in a folder of configurations."""
    return sorted(file.stem for file in (folder / group).glob("*.yaml"))


HOW = {
    "task": "prl.tasks.NAME(...), from_gymnasium(env_id, ...) or one of",
    "method": "prl.curricula.NAME(...) or one of",
}


def as_recipe(argument: str, group: Literal["task", "method"], given: Any) -> Recipe:
    """Returns a recipe, also of its name.

    Raises:
        ArgumentError: naming the argument, if it is neither.
    """
    if isinstance(given, Recipe) and given.group == group:
        return given
    if not isinstance(given, str) or given not in available(group):
        raise _refusal(f"{argument}={given!r}: must be {HOW[group]} {', '.join(available(group))}")
    return recipe_function(group, given)()


@cache
def recipe_function(group: Literal["task", "method"], name: str) -> Callable[..., Recipe]:
    """Returns the function ``prl.curricula.NAME`` or ``prl.tasks.NAME``.

    Raises:
        AttributeError: if there is no such file, with those that there are.
    """
    if name not in available(group):
        known = ", ".join(available(group))
        raise AttributeError(f"there is no {name!r}; there are: {known}")
    settings: dict[str, Any] = {}
    for more in _by_key(group, name).values():
        settings = {**more, **settings}
    del settings["_target_"]
    parameters = [
        inspect.Parameter(
            key,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if value == MISSING else value,
        )
        for key, value in settings.items()
    ]

    def make(**given: Any) -> Recipe:
        from proposer_rl.settings import check_names  # which help does without

        check_names(make, given)
        return Recipe(group, name, given)

    about = next(comments(CONFIG_FOLDER / group / f"{name}.yaml"))
    make.__name__ = make.__qualname__ = name
    make.__doc__ = f"{about}\n\nThe settings are those of conf/{group}/{name}.yaml."
    make.__signature__ = inspect.Signature(parameters, return_annotation=Recipe)  # type: ignore[attr-defined]
    return make


def filter_content(filter: Mapping[str, Any] | str) -> dict[str, Any]:
    """Returns what a filter sets below the keys ``filter`` and ``model``.

    Args:
        filter: a name in ``conf/filter``, or settings; with any of a model's, such as ``labels``,
            the rest is as in ``conf/filter/model.yaml``.

    Raises:
        ArgumentError: if there is no such file.
    """
    keys = ("filter", "model")
    if isinstance(filter, str):
        if filter not in available("filter"):
            raise _refusal(f"filter={filter!r}: must be one of {available('filter')}")
        content = file_content(f"filter/{filter}")
        return {key: content[key] for key in keys if key in content}
    known = file_content("filter/model")
    own = {name: value for name, value in filter.items() if name in known["model"]}
    rest = {name: value for name, value in filter.items() if name not in own}
    if not own:
        return {"filter": rest}
    return {"filter": known["filter"] | rest, "model": known["model"] | own}


def _by_key(group: str, name: str) -> dict[str, dict[str, Any]]:
    content = file_content(f"{group}/{name}")
    return {key: content.get(key) or {} for key in KEYS[group]}


def override(key: str, value: Any) -> str:
    """Returns a key and its value as one of Hydra's overrides; a function by its dotted name.

    Raises:
        ArgumentError: naming the key, as :func:`override_value`.
    """
    if isfunction(value):
        value = _dotted(key.lstrip("+"), value)
    try:
        return f"{key}={override_value(value)}"
    except ValueError as error:
        raise _refusal(f"{key.lstrip('+')}={error}") from error


def override_value(value: Any) -> str:
    r"""Returns a value of Python, NumPy or OmegaConf in Hydra's grammar of overrides.

    Raises:
        ArgumentError: if it is neither a number, a text, a list nor a mapping of such.

    Example:
        >>> override_value({"a": [1, None, True], "b": "it's"})
        "{a: [1, null, true], b: 'it\\'s'}"
    """
    from proposer_rl.settings import plain, shown  # which help does without

    value = plain(value)
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str | Path):
        # Hydra takes backslashes as they are, but for those before a quote: these are doubled.
        text = re.sub(r"(\\+)('|\Z)", r"\1\1\2", str(value))
        return "'" + text.replace("'", r"\'") + "'"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(k)}: {override_value(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(override_value, value)) + "]"
    raise _refusal(f"{shown(value)}: must be a number, a text, a list or a mapping of such")


def _key(key: Any) -> str:
    if not isinstance(key, str) or not KEY.fullmatch(key) or key.casefold() in CONSTANTS:
        raise _refusal(
            f"{key!r}: a name must begin with a letter, and have letters, digits, underscores, "
            "hyphens and single spaces alone"
        )
    return key


def file_content(name: str) -> dict[str, Any]:
    """Returns the content of a file such as ``method/plr``, merged over those it builds on."""
    content, group = yaml_file(name), name.partition("/")[0]
    parts = []
    for default in content.pop("defaults", ()):
        if isinstance(default, str) and default != "_self_":
            base = default.removesuffix("@_global_").removeprefix("/")
            parts.append(file_content(base if "/" in base else f"{group}/{base}"))
    return merged(*parts, content)


def merged(*settings: Mapping[str, Any]) -> dict[str, Any]:
    """Returns mappings merged key by key, later ones first; None replaces a whole mapping."""
    found: dict[str, Any] = {}
    for some in settings:
        for key, value in some.items():
            own = isinstance(value, Mapping)
            found[key] = merged(found.get(key) or {}, value) if own else value
    return found


def resolved(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the settings of a file, with references to ``train.yaml`` resolved."""
    train, found = yaml_file("train"), dict(settings)
    for name, value in settings.items():
        reference = REFERENCE.fullmatch(value) if isinstance(value, str) else None
        if reference is not None:
            found[name] = reduce(lambda place, key: place[key], reference[1].split("."), train)
    return found


def yaml_file(name: str) -> dict[str, Any]:
    """Returns the content of a configuration file, named from its folder on without ``.yaml``."""
    content = yaml.safe_load((CONFIG_FOLDER / f"{name}.yaml").read_text(encoding="utf-8"))
    return content or {}


def comments(file: Path) -> Iterator[str]:
    """Yields the lines of a file that begin with a #, without the one that Hydra reads."""
    # What is no UTF-8 is refused where it is used.
    for line in file.read_text(encoding="utf-8-sig", errors="replace").splitlines():
        if line.startswith("#") and not line.startswith("# @package"):
            yield line.lstrip("# ")


def _refusal(line: str) -> ValueError:
    from proposer_rl.settings import ArgumentError  # help needs none, and it takes time to import

    return ArgumentError(line)

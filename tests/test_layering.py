"""The rooms of the package and who may know of whom, read from its folders and files."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import networkx as nx

PACKAGE = "proposer_rl"
ROOT = Path(__file__).resolve().parents[1] / PACKAGE

# Only the command line and recipes compose configurations; everything else takes plain arguments.
# The one validator is pydantic's; so are the checks of a run's files and of what a browser asks.
COMPOSING = {"cli", "recipes"}
CONFIGURATION = {
    "hydra": COMPOSING,
    "omegaconf": COMPOSING,
    "pydantic": {"settings", "play", "runs"},
}
# What reads runs must start at once.
HEAVY = {"torch", "torchrl", "tensordict"}
READERS = ("report", "cli.watch", "cli.report")
# What is above everything: only these commands know of it, and nothing that a run is made of.
SHOWING = ("report", "play")
SHOW = {"cli.report", "cli.watch", "cli.play"}
TRAINING = ("cli.run", "cli.build", "methods", "experiment.loop", "teaching")
# The names of the package itself, the rooms that know mazes, and an environment with its own walls.
KNOW_MAZES = ("tasks.mazes", "tasks.view_mazes", "tasks.arena.planes", "api")


def imported_names(
    tree: ast.AST, package: tuple[str, ...] = (), functions: bool = True
) -> Iterator[str]:
    """Yield the dotted name of everything that a file imports, wherever in the file.

    ``from a import b`` yields ``a.b``: whether b is a module does not matter here. ``package`` is
    the package that the file lies in, from which relative imports count. Without ``functions`` it
    is what loading the file imports: neither what functions do nor what types are checked with.
    """
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            start = [*base, *([node.module] if node.module else [])]
            yield from (".".join([*start, alias.name]) for alias in node.names)
        elif functions or not (
            isinstance(node, ast.FunctionDef)
            or (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
        ):
            yield from imported_names(node, package, functions)


@cache
def modules(root: Path) -> dict[str, ast.Module]:
    """All modules by their dotted name within the package; that of a package is its folder's."""
    found = {}
    for path in sorted(root.rglob("*.py")):
        parts = [part for part in path.relative_to(root).with_suffix("").parts]
        name = ".".join(part for part in parts if part != "__init__")
        found[name] = ast.parse(path.read_text(encoding="utf-8"))
    return found


@cache
def imports(root: Path) -> dict[str, set[str]]:
    """What each module imports: other packages' names, and the package's own modules with a dot."""
    trees = modules(root)
    found: dict[str, set[str]] = {}
    for name, tree in trees.items():
        is_package = (root / Path(*name.split(".")) / "__init__.py").exists()
        package = [PACKAGE, *([] if not name else name.split("."))]
        names = imported_names(tree, tuple(package if is_package or not name else package[:-1]))
        found[name] = set()
        for imported in names:
            first, _, rest = imported.partition(".")
            if first != PACKAGE:
                found[name].add(first)
                continue
            # The longest part of it that is a module; the rest is a name in it.
            while rest and rest not in trees:
                rest = rest.rpartition(".")[0]
            found[name].add(f".{rest}")
    return found


def rooms(root: Path) -> dict[str, set[str]]:
    """The rooms that each room imports; the package's own ``__init__`` and ``api`` see all."""
    found: dict[str, set[str]] = {}
    for name, imported in imports(root).items():
        room = name.partition(".")[0]
        if room in ("", "api"):
            continue
        own = {other[1:].partition(".")[0] for other in imported if other.startswith(".")}
        found.setdefault(room, set()).update(own - {room})
    return found


def circle(graph: dict[str, set[str]]) -> list[str]:
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def reached(graph: dict[str, set[str]], start: str) -> set[str]:
    """Everything that is imported when a module is, directly or not, and the packages around."""
    arrows = [(f".{name}", used) for name, others in graph.items() for used in others]
    arrows += [(f".{name}", f".{name.rpartition('.')[0]}") for name in graph if "." in name]
    return {f".{start}", *nx.descendants(nx.DiGraph(arrows), f".{start}")}


class Code(ast.NodeTransformer):
    """Leaves out docstrings, and texts that describe what is above them."""

    def visit_Expr(self, node: ast.Expr) -> ast.AST:
        return ast.Pass() if isinstance(node.value, ast.Constant) else node


def mentions(tree: ast.Module, word: str) -> list[str]:
    """Lines of code with a word in them, without comments and docstrings."""
    lines = ast.unparse(Code().visit(tree)).splitlines()
    return [line for line in lines if word in line.casefold()]


def test_there_is_no_circle_between_rooms() -> None:
    graph = rooms(ROOT)
    assert circle(graph) == []
    unknown = {other for others in graph.values() for other in others} - graph.keys()
    assert unknown == set(), "import from the module that defines it, not from the package"


def test_few_rooms_see_configurations() -> None:
    graph = imports(ROOT)
    for tool, allowed in CONFIGURATION.items():
        users = {name.partition(".")[0] for name, used in graph.items() if tool in used}
        assert users == allowed, tool


def test_the_package_imports_no_research() -> None:
    assert [name for name, imported in imports(ROOT).items() if "research" in imported] == []


def test_what_reads_runs_needs_no_torch() -> None:
    graph = imports(ROOT)
    readers = [name for name in graph if any(f"{name}.".startswith(f"{r}.") for r in READERS)]
    assert len(readers) > len(READERS)
    for name in readers:
        assert not reached(graph, name) & HEAVY, name


def test_report_and_play_stand_above_everything() -> None:
    graph = imports(ROOT)
    knowing = {
        name
        for name, used in graph.items()
        if any(other[1:].partition(".")[0] in SHOWING for other in used if other[0] == ".")
        and name.partition(".")[0] not in SHOWING
    }
    assert knowing == SHOW
    for name in TRAINING:
        used = {other[1:].partition(".")[0] for other in reached(graph, name) if other[0] == "."}
        assert not used & {*SHOWING}, name


def test_only_what_assembles_runs_reads_checkpoints() -> None:
    graph = imports(ROOT)
    readers = {name.partition(".")[0] for name, used in graph.items() if ".runs.checkpoint" in used}
    assert readers == {"methods", "experiment", "play", "cli"}


def test_nothing_but_mazes_knows_mazes() -> None:
    found = {
        name: mentions(tree, "maze")
        for name, tree in modules(ROOT).items()
        if not any(f"{name}.".startswith(f"{known}.") for known in KNOW_MAZES)
    }
    assert {name: where for name, where in found.items() if where} == {}
    graph = imports(ROOT)
    for name in found.keys() - {""}:
        assert not any(
            f"{other}.".startswith((".tasks.mazes.", ".tasks.view_mazes.")) for other in graph[name]
        ), name


def test_the_docs_show_the_rooms() -> None:
    page = ROOT.parent / "docs" / "explanation" / "architecture.md"
    layout = page.read_text(encoding="utf-8").partition("## Layout")[2]
    cells = [line.split("|")[1::2] for line in layout.splitlines() if line.startswith("| `")]
    shown = {
        name.removesuffix("/").removesuffix(".py"): set(re.findall("`(.*?)`", line[1]))
        for line in cells
        for name in re.findall("`(.*?)`", line[0])
    }
    found = rooms(ROOT)
    assert shown.keys() - {"api"} == found.keys()
    # The command line is told of by what it does not know.
    assert shown.pop("cli") == found.keys() - found.pop("cli") - {"cli"}
    assert {room: shown[room] for room in found} == found

"""Imports go one way: a module of the package imports only modules of lower layers."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = "proposer_rl"
ROOT = Path(__file__).resolve().parents[1] / PACKAGE

# From low to high. Neighbours in one layer may import each other, as long as that makes no circle.
LAYERS = [
    {"capture", "adam"},
    {
        *("mazes", "models", "run_folder", "checkpoint", "lock"),
        *("settings", "streams", "signals", "finite", "machine"),
    },
    {"ppo", "evaluation", "rewards", "report", "advantages", "proposals", "solver_view"},
    {"level_sets"},
    {"meta_env"},
    {"copies"},
    {"workers"},
    {"curricula", "snr"},
    {"experiment"},
    {"task"},
    {"methods"},
    {"cli"},
    {"bench"},
]
RANK = {module: rank for rank, layer in enumerate(LAYERS) for module in layer}

# In the lowest layer even neighbours are strangers, but for these: all lie in a run's folder.
NEIGHBOURS = {("checkpoint", "run_folder"), ("lock", "run_folder")}

# These work with any environment and any level: they are reused where there are no mazes.
KNOW_NO_MAZES = {
    "ppo",
    "advantages",
    "proposals",
    "solver_view",
    "meta_env",
    "snr",
    "experiment",
    "copies",
    "workers",
}

# Everything but the command line takes plain arguments.
CONFIGURATION = {"hydra", "omegaconf", "pydantic"}


def imported_names(source: str, package: tuple[str, ...]) -> Iterator[str]:
    """Yields the dotted name of everything that a file imports, wherever in the file.

    ``from a import b`` yields ``a.b``: whether b is a module does not matter here. ``package`` is
    the package that the file lies in, from which relative imports count.
    """
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            start = [*base, *([node.module] if node.module else [])]
            yield from (".".join([*start, alias.name]) for alias in node.names)


def imports_of(root: Path) -> dict[str, set[str]]:
    """Returns what each top-level module imports; the package's own ``__init__`` may import all."""
    imports: dict[str, set[str]] = {}
    for path in sorted(root.rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        if parts == ("__init__",):
            continue
        names = imported_names(path.read_text(encoding="utf-8"), (PACKAGE, *parts[:-1]))
        imports.setdefault(parts[0], set()).update(names)
    return imports


def internal(module: str, names: set[str]) -> set[str]:
    """Returns the package's other top-level modules among the imported names."""
    parts = (name.split(".") for name in names)
    return {part[1] for part in parts if part[0] == PACKAGE and len(part) > 1} - {module}


def problems(root: Path) -> list[str]:
    """Returns one line for each import that goes the wrong way."""
    found = []
    imports = imports_of(root)
    for module, names in imports.items():
        if module not in RANK:
            found.append(f"{module}: unknown; give it its place in LAYERS of {Path(__file__).name}")
            continue
        if module != "cli":
            used = CONFIGURATION & {name.partition(".")[0] for name in names}
            found += [f"{module}: imports {name}, which only cli may" for name in sorted(used)]
        found += [
            f"{module}: imports {other}{reason}"
            for other in sorted(internal(module, names))
            if (reason := objection(module, other))
        ]
    return found + circles({module: internal(module, names) for module, names in imports.items()})


def objection(module: str, other: str) -> str:
    """Returns why a module must not import another, or nothing."""
    if other not in RANK:
        return ", which is no module: import from the module that defines it, not from the package"
    if module in KNOW_NO_MAZES and other == "mazes":
        return ", but must work without mazes"
    if RANK[other] > RANK[module]:
        return ", which is in a higher layer"
    if RANK[other] == RANK[module] == 1 and (module, other) not in NEIGHBOURS:
        return ", its neighbour in the lowest layer"
    return ""


def circles(graph: dict[str, set[str]]) -> list[str]:
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return ["circle: " + " -> ".join(error.args[1])]
    return []


def test_imports_go_one_way() -> None:
    assert problems(ROOT) == []


@pytest.mark.parametrize(
    ("file", "source", "expected"),
    [
        ("ppo.py", "from proposer_rl.mazes import Level", "must work without mazes"),
        ("meta_env.py", "def f():\n    from .mazes.levels import Level", "must work without mazes"),
        ("experiment.py", "import proposer_rl.mazes as m", "must work without mazes"),
        ("models/unet.py", "from ..mazes import levels", "neighbour in the lowest layer"),
        ("mazes/env.py", "from proposer_rl import streams", "neighbour in the lowest layer"),
        ("evaluation.py", "from . import meta_env", "higher layer"),
        ("curricula/target.py", "from proposer_rl.experiment import run", "higher layer"),
        ("curricula/a/b.py", "from ...cli import train", "higher layer"),
        ("methods/x.py", "import hydra.utils", "only cli may"),
        ("report/page.py", "from omegaconf import OmegaConf", "only cli may"),
        ("rewards.py", "import pydantic", "only cli may"),
        ("ppo.py", "from proposer_rl import MazeEnv", "not from the package"),
        ("surprise.py", "", "unknown; give it its place"),
    ],
)
def test_finds(tmp_path: Path, file: str, source: str, expected: str) -> None:
    _write(tmp_path, {file: source})
    found = problems(tmp_path)
    assert len(found) == 1
    assert expected in found[0]


@pytest.mark.parametrize(
    ("file", "source"),
    [
        ("__init__.py", "from proposer_rl.mazes import MazeEnv\nfrom proposer_rl.methods import x"),
        ("cli/train.py", "import hydra, pydantic\nfrom proposer_rl.methods import x"),
        ("checkpoint.py", "from proposer_rl.runs.folder import write_atomically"),
        ("mazes/env.py", "from .levels import Level\nfrom proposer_rl.mazes import distance"),
        ("meta_env.py", "import torch\nfrom .ppo import PPO\nfrom proposer_rl import models"),
        ("rewards.py", "from proposer_rl.mazes.evaluation import evaluate"),
    ],
)
def test_allows(tmp_path: Path, file: str, source: str) -> None:
    _write(tmp_path, {file: source})
    assert problems(tmp_path) == []


def test_finds_circles_within_a_layer(tmp_path: Path) -> None:
    _write(tmp_path, {"ppo.py": "from . import rewards", "rewards.py": "from . import ppo"})
    assert problems(tmp_path)[0].startswith("circle: ")


def _write(root: Path, files: dict[str, str]) -> None:
    for name, source in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(source, encoding="utf-8")

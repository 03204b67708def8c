"""What is built of the checkout works without it: archive, wheel, commands, configuration."""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml

from proposer_rl.recipes import available
from tests import minimal
from tests.test_bin import MODULES

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


class Built(NamedTuple):
    """A source archive, the wheel made of it, and the folder that this is unpacked in."""

    archive: Path
    wheel: Path
    site: Path


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Built:
    """Without the network: what builds it is an extra of the tests."""
    folder = tmp_path_factory.mktemp("dist")

    def build(target: str, source: Path) -> None:
        command = [sys.executable, "-m", "hatchling", "build", "--target", target]
        process = subprocess.run(
            [*command, "--directory", str(folder)],
            cwd=source, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert process.returncode == 0, process.stderr

    build("sdist", ROOT)
    (archive,) = folder.glob("*.tar.gz")
    with tarfile.open(archive) as tar:
        tar.extractall(folder / "source", filter="data")
    (source,) = (folder / "source").iterdir()
    build("wheel", source)  # of the archive, as an index would
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as unpacked:
        unpacked.extractall(folder / "site")
    return Built(archive, wheel, folder / "site")


# Each extra that a method, a task or a command names; the empty one is none.
NAMED = ["", "alp-gmm", "box2d", "minigrid", "mujoco", "play", "tensorboard"]


@pytest.fixture(scope="module")
def call_there(
    built: Built, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Callable[[str, Path], int]]:
    """Calls the commands with an extra, in a folder; returns the exit code."""
    environment = tmp_path_factory.mktemp("environment")
    sites = minimal.make_environment(environment, built.wheel, NAMED)
    kept = {name: os.environ[name] for name in ("PATH", "HOME") if name in os.environ}
    compiled = []
    if sys.pycache_prefix:
        minimal.share_bytecode(sys.pycache_prefix, sites.values())
        compiled = ["-X", f"pycache_prefix={sys.pycache_prefix}"]
    with subprocess.Popen(
        [environment / "bin" / "python", "-I", *compiled, minimal.__file__],
        cwd=environment,
        env=kept | {"OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdin is not None and process.stdout is not None
        asked, answers = process.stdin, process.stdout

        def there(extra: str, folder: Path) -> int:
            asked.write(json.dumps([extra, str(sites[extra]), str(folder)]) + "\n")
            asked.flush()
            return int(answers.readline())

        yield there
        asked.close()


@pytest.mark.parametrize("extra", NAMED, ids=[extra or "none" for extra in NAMED])
def test_everything_runs_where_only_what_it_requires_is_installed(
    extra: str, call_there: Callable[[str, Path], int], tmp_path: Path
) -> None:
    """The tests' tools are not there: what imports one of them, or expects it, fails here alone."""
    code = call_there(extra, tmp_path)
    said = (tmp_path / "output").read_text(encoding="utf-8")
    assert code == 0, said[-5000:]
    done = [line.split()[1:] for line in said.splitlines() if line.startswith("DID ")]
    assert done == list(minimal.commands(extra))


# What comes with the loop that is taught, or with a logger that the tests do without.
BROUGHT = {"stable_baselines3", "transformers", "wandb"}


def test_whatever_it_imports_anywhere_is_required(built: Built) -> None:
    """By itself or an extra; also in functions that no run calls."""
    (project,) = metadata.distributions(path=[str(built.site)])
    required = {name for extra in [*NAMED, "ray"] for name in minimal.closure(project, extra)}
    _, owners = minimal.installed()
    known = {"proposer_rl", *sys.stdlib_module_names, *BROUGHT}
    known |= {top.removesuffix(".py") for top in owners if owners[top] & required}
    for file in (ROOT / "proposer_rl").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and not node.level:
                names = [str(node.module)]
            assert {name.partition(".")[0] for name in names} <= known, file


def test_every_task_and_command_is_called() -> None:
    called = [words for extra in NAMED for words in minimal.commands(extra)]
    words = {word for command in called for word in command}
    # Of view mazes the smallest; gymnasium and batched are what others are made of; maze is given.
    tasks = set(available("task"))
    tasks -= {"maze", "gymnasium", "batched", "view_maze", "view_maze_quick"}
    assert {f"task={task}" for task in tasks} <= words
    assert {f"proposer-{name}" for name, *_ in called} == PROJECT["scripts"].keys()


def test_a_wheel_holds_the_package_and_its_configuration(built: Built) -> None:
    package = built.site / "proposer_rl"
    assert (package / "py.typed").is_file()
    for source, made in ((ROOT / "conf", package / "conf"), (ROOT / "proposer_rl", package)):
        wanted = {
            path.relative_to(source)
            for path in source.rglob("*")
            if path.is_file() and path.suffix != ".pyc"
        }
        assert wanted <= {path.relative_to(made) for path in made.rglob("*") if path.is_file()}
    (distribution,) = metadata.distributions(path=[str(built.site)])
    assert distribution.version == PROJECT["version"]
    assert distribution.metadata["License-Expression"] == "MIT"
    assert [file.name for file in distribution.files or [] if file.name == "LICENSE"]
    top = {Path(str(file)).parts[0] for file in distribution.files or []}
    # Some versions of pip also list the commands in bin/, from there.
    assert top - {".."} == {"proposer_rl", distribution._path.name}


def test_a_source_archive_holds_no_results_and_no_tests(built: Built) -> None:
    with tarfile.open(built.archive) as archive:
        top = {name.split("/")[1] for name in archive.getnames()}
    assert {"proposer_rl", "conf", "docs", "examples", "README.md", "CHANGELOG.md"} <= top
    assert "LICENSE" in top
    assert not {"results", "tests", ".ci", "site", "outputs"} & top


def test_every_command_of_the_checkout_is_installed() -> None:
    for name, started in MODULES.items():
        if started.startswith("proposer_rl"):
            module, _, function = PROJECT["scripts"][f"proposer-{name}"].partition(":")
            assert module.removesuffix(".__main__") == started.split()[0]
            source = ROOT / Path(*module.split(".")).with_suffix(".py")
            names = {getattr(node, "name", "") for node in ast.parse(source.read_text()).body}
            assert function in names


def test_the_version_is_the_same_everywhere() -> None:
    version = PROJECT["version"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == version
    assert citation["license"] == PROJECT["license"]
    assert citation["title"] == PROJECT["name"]
    headings = re.findall(r"^## \[([^]]+)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert headings[0] == version

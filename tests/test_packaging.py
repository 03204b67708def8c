"""What is built of the checkout works without it: archive, wheel, commands, configuration."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.test_bin import MODULES
from tests.test_layering import ROOT as PACKAGE
from tests.test_layering import imported_names, modules
from tests.test_readme import README, blocks

ROOT = Path(__file__).parents[1]
CONSTRAINTS = ROOT / "constraints.txt"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


class Built(NamedTuple):
    """A source archive, the wheel made of it, and the folders that they are unpacked in."""

    archive: Path
    wheel: Path
    source: Path
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
    return Built(archive, wheel, source, folder / "site")


def interpreter(version: str) -> str | None:
    """The path of an interpreter of a version, such as "3.12", that can make environments."""
    installed = sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python"))
    ours = sys.executable if sys.version.startswith(f"{version}.") else None
    for python in filter(None, [ours, shutil.which(f"python{version}"), *map(str, installed)]):
        tried = [python, "-c", "import ensurepip, venv"]
        if subprocess.run(tried, check=False, capture_output=True).returncode == 0:
            return python
    return None


def pip(folder: Path, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Calls the pip of an environment."""
    return subprocess.run(
        [folder / "bin" / "python", "-m", "pip", "--disable-pip-version-check", *arguments],
        cwd=folder, capture_output=True, text=True, check=False,
    )  # fmt: skip


def closure(project: metadata.Distribution, extra: str) -> set[str]:
    """Names of all distributions that one requires, and those require, with their extras."""
    found: set[tuple[str, str]] = set()

    def follow(distribution: metadata.Distribution, extras: set[str]) -> None:
        for line in distribution.requires or []:
            requirement = Requirement(line)
            for asked in {"", *extras}:
                marker = requirement.marker
                if marker is not None and not marker.evaluate({"extra": asked}):
                    continue
                name = canonicalize_name(requirement.name)
                new = {(name, inner) for inner in {"", *requirement.extras}} - found
                if new:
                    found.update(new)
                    follow(metadata.distribution(name), set(requirement.extras))

    follow(project, {extra} - {""})
    return {name for name, _ in found}


# What comes with the loop that is taught, or with a logger that the tests do without.
BROUGHT = {"stable_baselines3", "transformers", "wandb"}
EXTRAS = "alp-gmm", "box2d", "minigrid", "mujoco", "play", "ray", "tensorboard"
# What is loaded by those alone who have the extra.
OPTIONAL = {"play.server", "tasks.gymnasium.stumps", "teaching.sb3", "teaching.trl"}


def test_whatever_it_imports_is_required(built: Built) -> None:
    """Without an extra where files are loaded; with some extra in functions, too."""
    (project,) = metadata.distributions(path=[str(built.site)])
    owners = metadata.packages_distributions()

    def known(*extras: str) -> set[str]:
        required = {name for extra in extras for name in closure(project, extra)}
        found = {top for top in owners if required & {*map(canonicalize_name, owners[top])}}
        return {"proposer_rl", *sys.stdlib_module_names} | found

    alone, extras = known(""), known("", *EXTRAS)
    for name, tree in modules(PACKAGE).items():
        every = {*imported_names(tree)}
        assert {one.partition(".")[0] for one in every} <= extras | BROUGHT, name
        if name not in OPTIONAL:
            loaded = {*imported_names(tree, functions=False)}
            assert {one.partition(".")[0] for one in loaded} <= alone, name
            started = tuple(f"proposer_rl.{other}." for other in OPTIONAL)
            assert not [one for one in loaded if f"{one}.".startswith(started)], name


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


def test_a_source_archive_holds_all_but_the_results(built: Built) -> None:
    top = {path.name for path in built.source.iterdir()}
    assert {"proposer_rl", "conf", "docs", "examples", "tests", "research", "bin", ".ci"} <= top
    assert {"README.md", "CHANGELOG.md", "CONTRIBUTING.md", "CITATION.cff", "LICENSE"} <= top
    assert not {"results", "site", "outputs", ".venv"} & top


@pytest.mark.slow
def test_a_source_archive_passes_its_own_tests(built: Built) -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-n", "auto", "--dist", "worksteal"]
    done = subprocess.run(
        [*command, "-m", "not slow and not research"],
        cwd=built.source,
        env=os.environ | {"PYTHONPATH": str(built.source), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-5000:]


PYTHONS = [
    version
    for line in PROJECT["classifiers"]
    if re.fullmatch(r"3\.\d+", version := line.removeprefix("Programming Language :: Python :: "))
]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["wheel", "archive"])
@pytest.mark.parametrize("python", PYTHONS)
def test_pip_installs_it_in_a_new_environment(
    python: str, kind: str, built: Built, tmp_path: Path
) -> None:
    """Outside of the checkout, with the versions of constraints.txt."""
    found = interpreter(python)
    if found is None:
        pytest.skip(f"there is no Python {python} that can make an environment")
    with TemporaryDirectory() as name:  # a gigabyte and more, which pytest would keep
        folder = Path(name)
        subprocess.run([found, "-m", "venv", folder], check=True)
        (torch,) = re.findall("^torch==.*$", CONSTRAINTS.read_text(), re.MULTILINE)
        here = pip(folder, "install", "--dry-run", "--no-deps", "--no-index", torch)
        if here.returncode:
            pytest.skip(f"no {torch} for Python {python} lies where pip finds links")
        (project,) = metadata.distributions(path=[str(built.site)])
        required = [line for line in project.requires or [] if "extra ==" not in line]
        done = pip(folder, "install", "-q", "-c", CONSTRAINTS, torch, *required)
        if done.returncode:
            pytest.skip(f"pip cannot install what it requires: {done.stderr.splitlines()[-1]}")
        done = pip(folder, "install", "-q", "-c", CONSTRAINTS, getattr(built, kind))
        assert done.returncode == 0, done.stderr
        assert pip(folder, "check").returncode == 0
        lines = "\n".join(block for block in blocks("python", README) if "prl.Teacher(" in block)
        assert lines
        (tmp_path / "loop.py").write_text(f"import proposer_rl as prl\n{lines}")
        run = "outputs/run"
        for command, *arguments in (
            ["proposer-train", "+method=perf_gain", "+scale=smoke", f"hydra.run.dir={run}"],
            ["proposer-report", run],
            ["proposer-report", run, "--publish", "study"],
            ["python", "-I", "loop.py"],
        ):
            ended = subprocess.run(
                [folder / "bin" / command, *arguments],
                cwd=tmp_path,
                env={"PATH": os.environ["PATH"], "HOME": name},
                capture_output=True,
                text=True,
                check=False,
            )
            assert ended.returncode == 0, ended.stderr[-5000:]
        assert list(tmp_path.rglob("report.html"))


def test_the_same_versions_are_checked_everywhere() -> None:
    """Those of Python in the service's workflow, that of ruff before commits."""
    workflow = yaml.safe_load((ROOT / ".github/workflows/tests.yml").read_text(encoding="utf-8"))
    assert workflow["jobs"]["tests"]["strategy"]["matrix"]["python"] == PYTHONS
    (ruff,) = re.findall("^ruff==.*$", CONSTRAINTS.read_text(), re.MULTILINE)
    (hooks,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    assert [hook["additional_dependencies"] for hook in hooks["hooks"]] == [[ruff]] * 2


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

"""What is built of the checkout works without it: archive, wheel, commands, configuration."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import tarfile
import tomllib
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml

from tests.processes import python

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


class Installed(NamedTuple):
    """A source archive, and the folder that the wheel made of it is installed in."""

    archive: Path
    site: Path

    def __call__(self, command: str, *arguments: str, folder: Path) -> str:
        """Calls an installed command; the checkout is neither the folder nor on the path."""
        environment = os.environ | {"PYTHONPATH": str(self.site), "OMP_NUM_THREADS": "1"}
        process = subprocess.run(
            [sys.executable, str(self.site / "bin" / command), *arguments],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert process.returncode == 0, process.stderr
        return process.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """Without the network: what is needed besides comes from the environment of the tests."""
    folder = tmp_path_factory.mktemp("dist")

    def run(*arguments: str) -> None:
        command = [sys.executable, "-m", *arguments]
        process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        assert process.returncode == 0, process.stderr

    offline = ("--quiet", "--no-index", "--no-deps", "--disable-pip-version-check")
    run("hatchling", "build", "--target", "sdist", "--directory", str(folder))
    (archive,) = folder.glob("*.tar.gz")
    run("pip", "wheel", *offline, "--no-build-isolation", "-w", str(folder), str(archive))
    (wheel,) = folder.glob("*.whl")
    run("pip", "install", *offline, "--target", str(folder / "site"), str(wheel))
    return Installed(archive, folder / "site")


def test_it_trains_is_watched_and_reports_from_an_empty_folder(
    installed: Installed, tmp_path: Path
) -> None:
    said = installed("proposer-train", "+method=target", "+scale=smoke", folder=tmp_path)
    assert "target, seed 0: " in said
    (run,) = tmp_path.glob("outputs/target/*")
    assert (run / "summary.json").is_file()
    hydra = yaml.safe_load((run / ".hydra" / "hydra.yaml").read_text())["hydra"]
    sources = {source["provider"]: source["path"] for source in hydra["runtime"]["config_sources"]}
    assert sources["main"] == str(installed.site / "proposer_rl" / "conf")
    said = installed("proposer-watch", "outputs", "--once", folder=tmp_path)
    assert "target, seed 0" in said and "finished" in said
    installed("proposer-report", "outputs", "-o", "report", folder=tmp_path)
    assert (tmp_path / "report" / "report.html").is_file()


def test_a_sweep_finds_its_configuration(installed: Installed, tmp_path: Path) -> None:
    arguments = ["+sweep=quick", "+method=target", "+scale=smoke", "seed=0"]
    installed("proposer-train", *arguments, folder=tmp_path)
    (summary,) = tmp_path.glob("sweeps/quick/*/summary.json")
    assert summary.parent.name == "target-none-seed_0"


def test_a_wheel_holds_the_package_and_its_configuration(installed: Installed) -> None:
    package = installed.site / "proposer_rl"
    assert (package / "py.typed").is_file()
    for source, made in ((ROOT / "conf", package / "conf"), (ROOT / "proposer_rl", package)):
        wanted = {
            path.relative_to(source)
            for path in source.rglob("*")
            if path.is_file() and path.suffix != ".pyc"
        }
        assert wanted <= {path.relative_to(made) for path in made.rglob("*") if path.is_file()}
    (distribution,) = metadata.distributions(path=[str(installed.site)])
    assert distribution.version == PROJECT["version"]
    assert distribution.metadata["License-Expression"] == "MIT"
    assert [file.name for file in distribution.files or [] if file.name == "LICENSE"]
    top = {Path(str(file)).parts[0] for file in distribution.files or []}
    # Some versions of pip also list the commands in bin/, from there.
    assert top - {".."} == {"proposer_rl", distribution._path.name}


def test_a_source_archive_holds_no_results_and_no_tests(installed: Installed) -> None:
    with tarfile.open(installed.archive) as archive:
        top = {name.split("/")[1] for name in archive.getnames()}
    assert {"proposer_rl", "conf", "docs", "examples", "README.md", "CHANGELOG.md"} <= top
    assert "LICENSE" in top
    assert not {"results", "tests", ".ci", "site", "outputs"} & top


def test_every_command_of_the_checkout_is_installed() -> None:
    for file in (ROOT / "bin").iterdir():
        started = re.search(r'exec "\$PYTHON" -m (proposer_rl\S*)', file.read_text())
        if started:
            module, _, function = PROJECT["scripts"][f"proposer-{file.name}"].partition(":")
            assert module.removesuffix(".__main__") == started[1]
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


def test_levels_and_the_gymnasium_environment_come_along(
    installed: Installed, tmp_path: Path
) -> None:
    said = installed("proposer-eval", "--help", folder=tmp_path)
    assert "that comes along: shapes" in " ".join(said.split())
    code = "import gymnasium; print(gymnasium.make('proposer_rl.tasks.mazes:proposer_rl/Maze-v0'))"
    process = python(code, path=installed.site, folder=tmp_path)
    assert process.returncode == 0, process.stderr
    assert "proposer_rl/Maze-v0" in process.stdout

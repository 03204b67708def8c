"""Commands of a wheel where nothing can be imported but what it requires.

Run as a program, with the folder that the wheel is unpacked in, this file hides all packages that
are installed here and that neither the wheel nor one of its extras requires, as if they were not.
It imports what commands need, which takes seconds, and then calls commands in forks of itself: each
of its lines names an extra and where to work.
"""

from __future__ import annotations

import faulthandler
import gc
import json
import os
import shutil
import subprocess
import sys
import traceback
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import cache
from importlib import metadata
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any


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
    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

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


@cache
def installed() -> tuple[dict[str, list[str]], dict[str, set[str]]]:
    """The files of each distribution, and which of them have files below each first part."""
    from packaging.utils import canonicalize_name

    owners: dict[str, set[str]] = defaultdict(set)
    files = {}
    for distribution in metadata.distributions():
        name = canonicalize_name(distribution.name)
        # Not ``distribution.files``, which looks for each of a hundred thousand.
        record = (distribution.read_text("RECORD") or "").splitlines()
        files[name] = [line.split(",")[0].strip('"') for line in record]
        for top in {file.split("/")[0] for file in files[name]}:
            owners[top].add(name)
    return files, owners


class Required(PathFinder):
    """Finds what is required, and nothing else that is installed."""

    hidden: frozenset[str] = frozenset()

    @classmethod
    def find_spec(cls, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """As of any path, but for what is hidden."""
        hidden = path is None and fullname in cls.hidden
        return None if hidden else super().find_spec(fullname, path, target)

    @classmethod
    def only(cls, required: set[str]) -> None:
        """Hide what belongs to none of these distributions."""
        _, owners = installed()
        cls.hidden = frozenset(
            top.removesuffix(".py")
            for top in owners
            if not owners[top] & {"proposer-rl", *required}
        )


RUN = "runs"
LONGEST = 250  # seconds; a child that takes longer hangs: it shows where, and ends
SMALL = ["compute.progress=false", "schedule.updates=1", "schedule.evaluate_every=1"]
GYMNASIUM = [
    *SMALL, "task.max_steps=16", "task.evaluation.levels=2", "solver.batch_size=2",
    "solver.ppo.horizon=16", "solver.ppo.minibatches=2",
    "proposer.validation_levels=2", "proposer.probe_levels=2",
]  # fmt: skip
TASKS = {
    "box2d": ["lunar_lander", "bipedal_stumps"],
    "minigrid": ["minigrid", "multiroom"],
    "mujoco": ["half_cheetah"],
}
SMOKE = ["+scale=smoke", "compute.progress=false"]
FEW = [*SMOKE, "schedule.evaluate_every=4", "solver.ppo.horizon=5", "solver.ppo.epochs=1"]
FEW += ["task.maze.max_steps=5", "task.evaluation.levels=2", "task.network.channels=[8,8]"]
FEW += ["schedule.updates=1", "proposer.meta_episode_length=2"]
LONGER = ["schedule.updates=4"]  # two cycles of what learns, and levels enough to be replayed


def _trained(name: str, *arguments: str) -> list[str]:
    return ["train", *arguments, f"hydra.run.dir={RUN}/{name}"]


def commands(extra: str) -> Iterator[list[str]]:
    """What is called in the environment with an extra; with the empty one what needs none."""
    if extra == "":
        # One of each kind; tests/test_needs.py runs every method.
        for method in ("target", "accel", "perf_gain", "currot", "adaptive_mixture", "paired"):
            yield _trained(method, f"+method={method}", *FEW)
        # Runs go on; a Proposer that has learnt is taken over.
        for method in ("accel", "perf_gain"):
            yield _trained(method, f"+method={method}", *FEW, *LONGER)
        yield _trained("frozen", "+method=frozen_proposer", *FEW, f"checkpoint={RUN}/perf_gain")
        yield _trained("views", "task=view_maze_smoke", "+method=robust_plr", *SMALL)
        yield _trained("cartpole", "task=cartpole", "+method=model_transport", *GYMNASIUM)
        few = [*SMALL, "task.levels=2", "task.max_steps=8", "solver.ppo.horizon=8"]
        yield _trained("gates", "task=point_mass", "+method=domain_randomization", *few)
        yield _trained("robots", "task=robots", "+method=terrain_levels", *few)
        yield ["watch", RUN, "--once"]
        yield ["report", f"{RUN}/perf_gain", "-o", "report"]
        yield from (["eval", f"{RUN}/{name}", "--levels", "small"] for name in ("target", "views"))
    elif extra == "alp-gmm":
        # More episodes than a mixture is fitted after for the first time.
        few = ["curriculum.warmup=4", "curriculum.refit=4", "curriculum.components=2"]
        yield _trained("alp_gmm", "+method=alp_gmm", *FEW, *LONGER, *few)
    elif extra in TASKS:
        for task in TASKS[extra]:
            yield _trained(task, f"task={task}", "+method=domain_randomization", *GYMNASIUM)
    else:
        logger = ["logger=tensorboard"] if extra == "tensorboard" else []
        yield _trained("run", "+method=target", *FEW, *logger)
        if extra == "play":
            yield ["play", f"{RUN}/run"]


def _call(command: Callable[..., Any], name: str, arguments: list[str]) -> None:
    from hydra.core.global_hydra import GlobalHydra

    GlobalHydra.instance().clear()
    sys.argv = [f"proposer-{name}", *arguments]
    try:
        command()
    except SystemExit as end:
        assert not end.code, f"{sys.argv} ended with {end.code}"


def _interrupted(*_: Any, **__: Any) -> None:
    raise KeyboardInterrupt


def _undrawn(folder: Path, title: str) -> Path:
    """One picture is enough."""
    return folder / "run.png"


def _run(extra: str) -> None:
    from proposer_rl.cli import watch

    scripts = {script.name: script for script in metadata.entry_points(group="console_scripts")}
    if extra not in ("", "tensorboard"):  # which logs it
        watch.draw_run = _undrawn
    for name, *arguments in commands(extra):
        command = scripts[f"proposer-{name}"].load()
        if name == "report":
            from proposer_rl.report import build

            build.DRAWINGS = build.DRAWINGS[::3]  # curves, maps, and what was recorded
        if name == "play":  # until it would serve its page, which is among the wheel's files
            import uvicorn

            uvicorn.Server.run = _interrupted
        _call(command, name, arguments)
        print("DID", name, *arguments, flush=True)
        watch.draw_run = _undrawn
    if extra == "":
        import gymnasium

        gymnasium.make("proposer_rl.tasks.mazes:proposer_rl/Maze-v0")


def _end_with(function: Callable[..., None], *given: Any) -> None:
    """End this process with whether that has gone well."""
    code = 1
    try:
        function(*given)
        code = 0
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _main(site: str) -> None:
    gc.disable()  # of what is imported nothing is garbage
    (project,) = metadata.distributions(path=[site])
    required = {extra: closure(project, extra) for extra in json.loads(sys.argv[2])}
    # A checkout that is installed here in place is a folder of its own.
    sys.path[:] = [
        site,
        *(one for one in sys.path if one.startswith((sys.prefix, sys.base_prefix))),
    ]
    sys.meta_path[sys.meta_path.index(PathFinder)] = Required
    Required.only(required[""])
    # Of the tests' folder nothing else can be imported.
    spec = spec_from_file_location("composing", Path(__file__).with_name("composing.py"))
    assert spec is not None and spec.loader is not None
    spec.loader.exec_module(composing := module_from_spec(spec))
    composing.remember()
    from proposer_rl.cli import run  # takes seconds, before the forks

    assert run.__file__.startswith(site) and find_spec("pytest") is None
    assert "gymnasium" not in sys.modules  # which looks for an extra's environments at once
    gc.freeze()  # a child that looks for garbage would copy all that memory
    gc.enable()
    for line in sys.stdin:
        extra, folder = json.loads(line)
        child = os.fork()
        if child == 0:
            os.chdir(folder)
            output = os.open("output", os.O_CREAT | os.O_WRONLY)
            os.dup2(output, 1)
            os.dup2(output, 2)
            faulthandler.dump_traceback_later(LONGEST, exit=True, file=2)
            Required.only(required[extra])
            _end_with(_run, extra)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


if __name__ == "__main__":
    _main(sys.argv[1])

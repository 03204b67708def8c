"""Real processes, killed with SIGKILL, against a run that was never stopped."""

from __future__ import annotations

import random
from pathlib import Path
from signal import SIGKILL
from typing import Any

import pytest
from omegaconf import OmegaConf

from proposer_rl.cli.config import methods
from proposer_rl.cli.places import CONFIG_FOLDER
from tests.processes import Ended, Processes
from tests.same_run import assert_same_run

# A checkpoint at every safe point. Episodes of a Proposer's copies are none: they are played again.
SMOKE = ["+scale=smoke", "compute.progress=false", "schedule.checkpoint_seconds=1e-6"]
SMOKE += ["proposer.meta_episode_length=5"]
# At any time; before any write; in the middle of a checkpoint's temporary file; before it gets its
# name. Methods that follow one another meet others of them, every third one after another.
MOMENTS = ["", "", "fsync .step_", "replace .step_"]
KINDS = [[0, 2], [1], [3]]


def factory(method: str) -> str:
    """What makes a method's curriculum, which one that is built on another takes over."""
    config = OmegaConf.load(CONFIG_FOLDER / "method" / f"{method}.yaml")
    return OmegaConf.select(config, "curriculum._target_") or factory(config.defaults[0])


# Methods of one factory differ in numbers; that each of them resumes is tested without processes.
METHODS = list({factory(method): method for method in reversed(methods())}.values())


def moment(draw: random.Random, kind: int, whole: Ended) -> dict[str, Any]:
    """A seeded moment not too late in a run, which has further ones before it, as an option."""
    if kind == 0:
        return {"signals": [(draw.uniform(0.3, 0.6) * whole.seconds, SIGKILL)]}
    early = whole.writes[: len(whole.writes) * 2 // 5]
    candidates = [i for i, name in enumerate(early) if name.startswith(MOMENTS[kind])]
    return {"signal_at": {draw.choice(candidates): SIGKILL}}


@pytest.fixture(scope="module")
def learnt(processes: Processes, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose Proposer the method frozen_proposer goes on with."""
    folder = tmp_path_factory.mktemp("learnt")
    assert processes("+method=perf_gain", *SMOKE, f"hydra.run.dir={folder}").code == 0
    return folder


@pytest.mark.parametrize("method", METHODS)
def test_killed_at_random_moments_a_run_is_that_which_was_never_stopped(
    method: str, learnt: Path, processes: Processes, tmp_path: Path
) -> None:
    draw = random.Random(f"moments of {method}")
    command = [f"+method={method}", *SMOKE]
    if method == "frozen_proposer":
        command.append(f"checkpoint={learnt}")
    whole = processes(*command, f"hydra.run.dir={tmp_path / 'whole'}")
    assert whole.code == 0, whole.output
    kinds, attempt = [*KINDS[METHODS.index(method) % len(KINDS)]], 0
    while kinds:
        folder = tmp_path / str(attempt)
        options = moment(draw, kinds[-1], whole)
        ended = processes(*command, f"hydra.run.dir={folder}", **options)
        if ended.code == -SIGKILL:
            kinds.pop()
        else:  # it came to its end before that moment; the next is that of another run
            assert ended.code == 0, ended.output
            assert_same_run(tmp_path / "whole", folder)
            attempt += 1
    ended = processes(*command, f"hydra.run.dir={folder}")
    assert ended.code == 0, ended.output
    assert_same_run(tmp_path / "whole", folder)

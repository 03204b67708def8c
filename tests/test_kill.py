"""Real processes, killed with SIGKILL, against a run that was never stopped."""

from __future__ import annotations

import random
from pathlib import Path
from signal import SIGKILL
from typing import Any

import pytest

from tests.processes import Ended, Processes
from tests.same_run import assert_same_run

# A checkpoint at every safe point. Episodes of a Proposer's copies are none: they are played again.
SMOKE = ["+scale=smoke", "compute.progress=false", "schedule.checkpoint_seconds=1e-6"]
SMOKE += ["schedule.updates=4", "proposer.meta_episode_length=3"]
# At any time; before any write; in the middle of a checkpoint's temporary file; before it gets its
# name. A method meets some of them, one after another; which ones, methods have no part in.
MOMENTS = ["", "", "fsync .step_", "replace .step_"]
# In one process every curriculum is taken up from its state, in tests/curricula/test_contract.py.
# These differ in what a checkpoint holds of them: a buffer, and a Proposer that learns.
METHODS = {"plr": [1, 3], "perf_gain": [0, 2]}


def moment(draw: random.Random, kind: int, whole: Ended) -> dict[str, Any]:
    """A seeded moment not too late in a run, which has further ones before it, as an option."""
    if kind == 0:
        return {"signals": [(draw.uniform(0.3, 0.6) * whole.seconds, SIGKILL)]}
    early = whole.writes[: len(whole.writes) * 2 // 5]
    candidates = [i for i, name in enumerate(early) if name.startswith(MOMENTS[kind])]
    return {"signal_at": {draw.choice(candidates): SIGKILL}}


@pytest.mark.parametrize("method", METHODS)
def test_killed_at_random_moments_a_run_is_that_which_was_never_stopped(
    method: str, processes: Processes, tmp_path: Path
) -> None:
    draw = random.Random(f"moments of {method}")
    command = [f"+method={method}", *SMOKE]
    whole = processes(*command, f"hydra.run.dir={tmp_path / 'whole'}")
    assert whole.code == 0, whole.output
    kinds, attempt = [*METHODS[method]], 0
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

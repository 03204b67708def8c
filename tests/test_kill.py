"""Real processes, killed with SIGKILL, against a run that was never stopped."""

from __future__ import annotations

import random
from pathlib import Path
from signal import SIGKILL
from typing import Any

from tests.commands import SMOKE
from tests.processes import Processes
from tests.same_run import assert_same_run

# A checkpoint at every safe point. Episodes of a Proposer's copies are none: they are played again.
FEW = [*SMOKE, "schedule.checkpoint_seconds=1e-6", "schedule.updates=4"]
FEW += ["proposer.ppo.epochs=1", "task.evaluation.distributions=[id]", "task.evaluation.levels=2"]
# At any time; before any write; in the middle of a checkpoint's temporary file; before it gets its
# name: a run meets them one after another. In one process every curriculum is taken up from its
# state, in tests/curricula/test_contract.py; this one has a Proposer that learns, too.
MOMENTS = ["", "", "fsync .step_", "replace .step_"]


def moment(draw: random.Random, kind: int, seconds: float, writes: list[str]) -> dict[str, Any]:
    """A seeded moment not too late in a run, which has further ones before it, as an option."""
    if kind == 0:
        return {"signals": [(draw.uniform(0.3, 0.6) * seconds, SIGKILL)]}
    early = writes[: len(writes) * 2 // 5]
    candidates = [i for i, name in enumerate(early) if name.startswith(MOMENTS[kind])]
    return {"signal_at": {draw.choice(candidates): SIGKILL}}


def test_killed_at_random_moments_a_run_is_that_which_was_never_stopped(
    processes: Processes, tmp_path: Path
) -> None:
    draw = random.Random("moments")
    command = ["+method=perf_gain", *FEW]
    whole = processes(*command, f"hydra.run.dir={tmp_path / 'whole'}")
    assert whole.code == 0, whole.output
    kinds, attempt, seconds = [*range(len(MOMENTS))], 0, whole.seconds
    while kinds:
        folder = tmp_path / str(attempt)
        options = moment(draw, kinds[-1], seconds, whole.writes)
        ended = processes(*command, f"hydra.run.dir={folder}", **options)
        if ended.code == -SIGKILL:
            kinds.pop()
        else:  # it came to its end before that moment; the next is that of another run
            assert ended.code == 0, ended.output
            assert_same_run(tmp_path / "whole", folder)
            attempt += 1
            seconds /= 2  # the machine may have been busy when it was measured
            assert attempt < 10
    ended = processes(*command, f"hydra.run.dir={folder}")
    assert ended.code == 0, ended.output
    assert_same_run(tmp_path / "whole", folder)

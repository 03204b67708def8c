"""The frames that runs say they cost, against the steps that their environments make."""

from __future__ import annotations

from pathlib import Path

import pytest

from proposer_rl.cli.build import build, parts
from proposer_rl.experiment import Experiment
from proposer_rl.runs.folder import RunFolder, read_csv
from proposer_rl.runs.process import Interrupted, StopSignals
from proposer_rl.tasks.mazes import MazeEnv
from tests.commands import LITTLE
from tests.same_run import StopAt
from tests.tiny import composed

# Where frames are spent: in proposing, in observing, in improving.
SPENT = {
    "propose": ["+method=robust_plr", "curriculum.capacity=16"],
    "propose, sampled": [
        "+method=sfl",
        "+score=sampled",
        "curriculum.candidates=16",
        "curriculum.keep=8",
    ],
    "observe": ["+method=paired"],
    "improve": ["+method=perf_gain"],
}


def experiment(folder: Path, arguments: list[str], signals: StopSignals) -> Experiment:
    scale = ["+scale=smoke", "compute.progress=false", *LITTLE]
    scale += [
        "schedule.updates=4",
        "schedule.cycle_length=2",
        "proposer.meta_episode_length=2",
        "task.maze.max_steps=5",
    ]
    config = composed(arguments[0], *scale, *arguments[1:])
    return build(config, parts(config, signals), RunFolder(folder), signals)


@pytest.mark.parametrize("arguments", SPENT.values(), ids=SPENT.keys())
def test_the_frames_are_the_steps_that_were_made_also_after_a_resume(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []
    step = MazeEnv._step

    def counted(self: MazeEnv, *given: object) -> object:
        made.append(self.batch_size.numel())
        return step(self, *given)

    monkeypatch.setattr(MazeEnv, "_step", counted)
    summary = experiment(tmp_path / "whole", arguments, StopSignals()).run()
    assert summary["frames"] == 4 * 4 * 5
    assert summary["frames"] + summary["curriculum_frames"] == sum(made)
    assert summary["curriculum_frames"] > 0
    with pytest.raises(Interrupted):
        experiment(tmp_path / "again", arguments, StopAt(3)).run()
    assert len(read_csv(tmp_path / "again" / "metrics.csv")) < 3
    experiment(tmp_path / "again", arguments, StopSignals()).run()
    whole, again = (
        [{**row, "seconds": 0} for row in read_csv(tmp_path / name / "metrics.csv")]
        for name in ("whole", "again")
    )
    assert whole == again
    for cost in ("curriculum_frames", "evaluations"):
        assert whole[-1][cost] == summary[cost]

"""What methods say that they need, against what they ask for while they train."""

from __future__ import annotations

import copy
from functools import wraps
from pathlib import Path
from typing import Any

import pytest

from proposer_rl.cli.build import build, parts
from proposer_rl.cli.help import needs
from proposer_rl.meta.assembly import ProposerSettings
from proposer_rl.meta.rewards import performance_gain
from proposer_rl.methods import Components, proposer
from proposer_rl.recipes import CONFIG_FOLDER
from proposer_rl.runs.folder import RunFolder, read_csv
from proposer_rl.runs.process import StopSignals
from proposer_rl.tasks.mazes.task import MazeTask
from research.ranking import EXACT, GRADIENTS, TARGET
from tests.tiny import TASK, composed

NEEDS = needs([CONFIG_FOLDER])
REUSED = "frozen_proposer"  # of another run's checkpoint
OF_ITEMS = {"pass rates of items", "categories of items"}
SMALL = ["+scale=smoke", "compute.progress=false", "schedule.updates=2", "hand_designed.until=[1]"]


class Watched:
    """A distribution that notes when somebody asks for something of it."""

    def __init__(self, distribution: Any, asked: list[str]) -> None:
        self._distribution, self._asked = distribution, asked

    def __getattr__(self, name: str) -> Any:
        self._asked.append(name)
        return getattr(self._distribution, name)


def test_a_proposer_observes_what_the_task_tells() -> None:
    task = copy.copy(TASK)
    task.performance = lambda *given: TASK.performance(*given).exclude("success")
    chosen = ProposerSettings(rollouts=2, validation_levels=4, probe_levels=2)
    said = r"^proposer\.observes=\['log_success', 'progress'\]: this task has no log_success"
    with pytest.raises(ValueError, match=said):
        proposer(Components(task, chosen, 0), reward=performance_gain)


def test_every_method_says_what_it_needs() -> None:
    assert set(NEEDS) == {file.stem for file in (CONFIG_FOLDER / "method").glob("*.yaml")}
    known = {TARGET, EXACT, GRADIENTS, "a schedule", "a Proposer that has learnt", *OF_ITEMS}
    assert {need for found in NEEDS.values() for need in found} == known
    assert "a Proposer that has learnt" in NEEDS[REUSED]


@pytest.mark.parametrize(
    "method", sorted(m for m in NEEDS.keys() - {REUSED} if not OF_ITEMS & {*NEEDS[m]})
)
def test_every_method_runs_and_asks_for_what_it_says(
    method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    made = MazeTask.__init__

    @wraps(made)  # settings are checked against its types
    def watched(self: MazeTask, **given: Any) -> None:
        made(self, **given)
        self.target = self.distributions[given["target"]] = Watched(self.target, asked)

    monkeypatch.setattr(MazeTask, "__init__", watched)
    config, signals = composed(f"+method={method}", *SMALL), StopSignals()
    summary = build(config, parts(config, signals), RunFolder(tmp_path), signals).run()
    assert summary["frames"] == 2 * 4 * 10
    for name in ("metrics", "training"):
        assert read_csv(tmp_path / f"{name}.csv")[-1]["updates"] == 2
    assert 0 <= read_csv(tmp_path / "metrics.csv")[-1]["ood_success"] <= 1
    assert bool(asked) == (TARGET in NEEDS[method]), asked
    assert (summary["evaluations"] > 0) == (EXACT in NEEDS[method])
    assert GRADIENTS not in NEEDS[method] or EXACT in NEEDS[method]

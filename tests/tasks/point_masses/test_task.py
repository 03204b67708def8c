"""The point mass as a task: its levels and runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from proposer_rl.runs.folder import read_csv
from proposer_rl.streams import Streams
from tests.same_run import assert_same_run
from tests.tiny import point_masses

TINY = [
    "task=point_mass", "compute.progress=false", "task.max_steps=6", "task.levels=4",
    "solver.batch_size=4", "solver.ppo.horizon=6", "solver.ppo.epochs=1",
    "solver.ppo.minibatches=2", "solver.ppo.anneal_updates=null", "schedule.updates=4",
    "schedule.evaluate_every=2",
    "proposer.rollouts=2", "proposer.meta_episode_length=2", "proposer.validation_levels=4",
    "proposer.probe_levels=2", "pool.capacity=8", "pool.candidates=8", "pool.keep=4",
]  # fmt: skip


def test_the_target_is_where_it_is_said_to_be() -> None:
    task: Any = point_masses()
    levels = task.target.sample(500, Streams(0).generator())
    assert float(levels["position"].mean()) == pytest.approx(2.5, abs=1e-3)
    assert float(levels["position"].std()) == pytest.approx(0.004, abs=1e-3)
    assert set(levels["width"].tolist()) == {0.5} and set(levels["friction"].tolist()) == {0.0}
    (bin_,) = (task.target_shares > 0.5).nonzero().flatten().tolist()
    place = [part.item() for part in torch.unravel_index(torch.tensor(bin_), (8, 5, 2))]
    assert place == [6, 0, 0]


@pytest.mark.usefixtures("own_folder")
@pytest.mark.parametrize(
    "method",
    [pytest.param(["+method=accel"], marks=pytest.mark.slow), ["+method=model_transport"],
     ["+method=alp_gmm", "curriculum.rounded=false", "curriculum.warmup=4",
     "curriculum.refit=4", "curriculum.components=2"],
     pytest.param(["+method=adr", "curriculum.rounded=false", "curriculum.episodes=1"],
     marks=pytest.mark.slow),
     pytest.param(["+method=spdl", "curriculum.rounded=false", "curriculum.episodes=4",
     "curriculum.measure=return"], marks=pytest.mark.slow),
     pytest.param(["+method=mixture"], marks=pytest.mark.slow)],
)  # fmt: skip
def test_runs_resume_with_the_same_bytes(method: list[str], train: Any) -> None:
    whole, parts = Path("whole"), Path("parts")
    assert train(*TINY, *method, f"hydra.run.dir={whole}") == 0
    for updates in (2, 4):
        words = [*TINY, *method, f"schedule.updates={updates}", f"hydra.run.dir={parts}"]
        assert train(*words, "schedule.checkpoint_every=2") == 0
    assert read_csv(whole / "metrics.csv")[-1]["updates"] == 4
    assert_same_run(whole, parts)

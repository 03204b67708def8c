"""A run with normalised observations and rewards, as the other commands read it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from proposer_rl.api import Run
from proposer_rl.cli.evaluate import evaluate, load
from proposer_rl.cli.play import open_session
from proposer_rl.play.session import Drawn
from tests.tasks.gymnasium.toys import TINY

pytestmark = pytest.mark.usefixtures("own_folder")
NORMALIZED = ["solver.ppo.normalize_observations=true", "solver.ppo.normalize_rewards=true"]


def test_every_command_reads_the_moments_of_the_training(train: Any) -> None:
    run = ["task=cartpole", "+method=plr", *TINY, *NORMALIZED, "task.evaluation.actions=sampled"]
    assert train(*run, "hydra.run.dir=run") == 0
    solver = Run(Path("run")).solver()
    frames = 4 * 4 * 12  # updates, environments, steps
    moments = solver.normalization
    assert moments is not None and moments.returns is not None
    assert moments.observations["observation"].count.tolist() == [frames]
    assert moments.returns.count.tolist() == [frames]

    stored, stage = load(Path("run"))
    levels = stored.task.evaluated_on["target"]

    def first_logits(agent: Any) -> torch.Tensor:
        state = stored.task.evaluation_environment(levels.unsqueeze(0)).reset()
        return agent(state)["logits"]

    assert torch.equal(first_logits(stage.learner.agent), first_logits(solver))
    evaluation = evaluate((stored, stage), None)
    session = open_session(Path("run"))
    checkpoint = session.about()["checkpoints"][-1]
    question = Drawn(source="distribution", name="target", seed=3, checkpoint=checkpoint, solver=0)
    drawn = session.levels(question)
    assert json.dumps(drawn) == json.dumps(session.levels(question))  # nothing has moved
    assert len(evaluation.results) and len(drawn["levels"])
    before = first_logits(solver)
    solver.normalization = None
    assert not torch.allclose(before, first_logits(solver))

"""Lengths of gradients against derivatives that are taken in other ways."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor

from proposer_rl.learning import PPO
from proposer_rl.meta import first_order
from proposer_rl.meta.first_order import LevelGradients
from proposer_rl.models import ActorCritic
from proposer_rl.streams import Streams
from proposer_rl.tasks.mazes import Level
from tests.meta.test_first_order import central_differences, learner, performance, some_levels
from tests.tiny import TASK


class Precise:
    """Policies of a few numbers in double precision, as much of a task as is asked of one here."""

    device = torch.device("cpu")

    def learner(self, streams: Sequence[Streams]) -> PPO:
        return learner(some_levels(len(streams), 1), len(streams))

    def differentiable_performance(self, agent: ActorCritic, levels: Level) -> TensorDictBase:
        return performance(agent, levels)


def numerical(ppo: PPO, levels: Level) -> Tensor:
    """Sums of squared central differences over every single parameter: float [K, n]."""
    total = torch.zeros(levels.batch_size, dtype=torch.float64)
    for *_, slope in central_differences(
        ppo.agent, lambda: performance(ppo.agent, levels)["return"]
    ):
        total += slope.square()
    return total


def one_by_one(ppo: PPO, value: Callable[[], Tensor]) -> Tensor:
    """|grad|^2 of each of the values [K, n], by a backward pass of its own and nothing else."""
    found = torch.zeros(value().shape, dtype=value().dtype)
    for k, i in product(*map(range, found.shape)):
        ppo.agent.zero_grad()
        value()[k, i].backward()
        found[k, i] = sum(
            p.grad.square().sum() for p in ppo.agent.parameters() if p.grad is not None
        )
    return found


@pytest.mark.parametrize("at_once", [1, 3, 8])
def test_they_are_those_of_finite_differences(
    at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(first_order, "LEVELS_AT_ONCE", at_once)
    ppo, levels = learner(some_levels(2, 1)), some_levels(2, 4)
    found = LevelGradients(Precise()).of_returns(ppo, levels)
    torch.testing.assert_close(found, numerical(ppo, levels), rtol=1e-6, atol=1e-12)
    assert not found.requires_grad and (found[0] != found[1]).all()


def test_they_are_those_of_single_levels_also_after_training() -> None:
    ppo = TASK.learner([Streams(0), Streams(1)])
    score = LevelGradients(TASK).of_returns
    levels = torch.stack([TASK.space.sample(5, Streams(k).generator()) for k in (0, 1)])
    for _ in range(2):  # the same population serves Solvers that have changed
        before = ppo.snapshot()
        found = score(ppo, levels)
        assert (ppo.snapshot() == before).all()
        expected = one_by_one(
            ppo, lambda: TASK.differentiable_performance(ppo.agent, levels)["return"]
        )
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-9)
        ppo.update([Streams(k).generator("actions") for k in (0, 1)])


def test_those_of_episodes_are_of_single_policy_gradients() -> None:
    ppo = TASK.learner([Streams(0), Streams(1)])
    ppo.update([Streams(k).generator("first") for k in (0, 1)])  # a fresh policy is nearly even
    rollout = ppo.collect([Streams(k).generator("actions") for k in (0, 1)])
    advantage = torch.randn(rollout.shape, generator=torch.Generator().manual_seed(0))
    found = LevelGradients(TASK).of_rollouts(ppo, rollout, advantage)

    def gained() -> Tensor:
        steps = ppo.agent(rollout.exclude("next").clone())["logits"].log_softmax(-1)
        taken = steps.gather(-1, rollout["action"].unsqueeze(-1)).squeeze(-1)
        return (taken * advantage).mean(-1)

    torch.testing.assert_close(found, one_by_one(ppo, gained), rtol=1e-3, atol=1e-9)


def test_nothing_is_drawn_at_random() -> None:
    ppo, levels = TASK.learner([Streams(0)]), TASK.space.sample(2, Streams(0).generator())[None]
    torch.manual_seed(3)
    expected = torch.rand(4)
    torch.manual_seed(3)
    LevelGradients(TASK).of_returns(ppo, levels)
    assert torch.equal(torch.rand(4), expected)


def test_where_the_return_cannot_change_it_is_zero() -> None:
    solvable, walled = "S..\n...\n..G", "S#.\n##.\n..G"
    levels = Level.from_text([walled, solvable, walled]).reshape(1, 3)
    found = LevelGradients(Precise()).of_returns(learner(levels, 1), levels)
    assert found[0, 0] == found[0, 2] == 0 < found[0, 1]


def test_the_uniform_policy_next_to_the_goal_in_closed_form() -> None:
    """With p = 1/4 to go right, J = 1 - (1 - p)^8 - 0.01 * sum over t < 8 of (1 - p)^t.

    The slope towards the logit of action a is dJ/dp p (1[a = right] - p). A logit has a bias and
    two weights whose inputs are 1: of the start here, and of the goal to the right.
    """
    levels = Level.from_text("SG").reshape(1, 1)
    ppo = learner(levels, 1)
    for parameter in ppo.agent.parameters():
        parameter.data.zero_()
    slope = 8 * 0.75**7 + 0.01 * sum(t * 0.75 ** (t - 1) for t in range(8))
    expected = 3 * slope**2 * sum((0.25 * ((a == 3) - 0.25)) ** 2 for a in range(4))
    found = LevelGradients(Precise()).of_returns(ppo, levels)
    assert found.item() == pytest.approx(expected, rel=1e-12)


def test_frozen_parameters_add_nothing() -> None:
    class Frozen(Precise):
        """The same without their biases' training."""

        def learner(self, streams: Sequence[Streams]) -> PPO:
            ppo = super().learner(streams)
            [*ppo.agent.parameters()][1].requires_grad_(False)
            return ppo

    levels = some_levels(2, 3)
    found = LevelGradients(Frozen()).of_returns(ppo := Frozen().learner([Streams(0)] * 2), levels)
    expected = one_by_one(ppo, lambda: performance(ppo.agent, levels)["return"])
    torch.testing.assert_close(found, expected)
    assert (found < LevelGradients(Precise()).of_returns(ppo, levels)).all()

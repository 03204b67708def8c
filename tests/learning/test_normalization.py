"""Normalised observations and rewards, against plain means and variances over all frames."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from proposer_rl.curricula import TaskStudent
from proposer_rl.learning import PPO, PPOSettings, SolverSettings, agent_weights, load_agent
from proposer_rl.meta.first_order import LevelGradients
from proposer_rl.models.actor_critic import FARTHEST, RunningMoments
from proposer_rl.streams import Streams
from tests.draws import generators
from tests.tasks.gymnasium.toys import walk_task

K, P, T = 2, 3, 5
SETTINGS = PPOSettings(
    horizon=T,
    epochs=2,
    minibatches=3,
    learning_rate=1e-2,
    normalize_observations=True,
    normalize_rewards=True,
    gamma=0.9,
)


def made(**changed: Any) -> tuple[Any, PPO]:
    task = walk_task(solver=SolverSettings(batch_size=P, ppo=replace(SETTINGS, **changed)))
    learner = task.learner([Streams(seed) for seed in range(K)])
    learner.env.set_levels(torch.stack([task.evaluated_on["target"][:P]] * K))
    return task, learner


@pytest.fixture(scope="module", params=[False, True], ids=["from resets", "continued"])
def trained(request: pytest.FixtureRequest) -> Any:
    task, learner = made(continue_episodes=request.param)
    draws = generators(*range(K))
    return task, learner, [learner.update(draws).rollout for _ in range(4)]


@given(st.lists(st.integers(1, 5), min_size=1, max_size=4), st.floats(-1e3, 1e3))
def test_moments_in_parts_are_those_of_all_numbers(sizes: list[int], shift: float) -> None:
    values = torch.randn(K, sum(sizes), 2, generator=torch.Generator().manual_seed(0)) + shift
    moments = RunningMoments(K, [2])
    for part in values.split(sizes, 1):
        moments.update(part)
    exact = values.double().numpy()
    assert moments.count.tolist() == [sum(sizes)] * K
    np.testing.assert_allclose(moments.mean, exact.mean(1), rtol=1e-9)
    np.testing.assert_allclose(moments.variance, exact.var(1), rtol=1e-6, atol=1e-9)


def test_observations_have_the_moments_of_all_frames(trained: Any) -> None:
    _, learner, rollouts = trained
    seen = np.concatenate([rollout["observation"].double().numpy() for rollout in rollouts], 2)
    moments = learner.agent.normalization.observations["observation"]
    for k in range(K):
        frames = seen[k].reshape(-1, 2)
        np.testing.assert_allclose(moments.mean[k], frames.mean(0), rtol=1e-6)
        np.testing.assert_allclose(moments.variance[k], frames.var(0), rtol=1e-6, atol=1e-9)


def test_the_unit_of_values_is_the_deviation_of_discounted_returns(trained: Any) -> None:
    _, learner, rollouts = trained
    for k in range(K):
        numbers, running = [], [0.0] * P
        for rollout in rollouts:
            if not learner.settings.continue_episodes:
                running = [0.0] * P
            for t in range(T):
                for p in range(P):
                    reward = float(rollout["next", "reward"][k, p, t])
                    running[p] = SETTINGS.gamma * running[p] + reward
                    numbers.append(running[p])
                    if rollout["next", "done"][k, p, t]:
                        running[p] = 0.0
        deviation = learner.agent.normalization.returns.deviation[k]
        assert float(deviation) == pytest.approx(np.std(numbers), rel=1e-5)


def test_the_network_gets_numbers_in_deviations_from_the_mean(trained: Any) -> None:
    _, learner, rollouts = trained
    agent, state = learner.agent, rollouts[-1].select("observation").clone()
    state["observation"][0, 0, 0, 0] = 1e6
    moments = agent.normalization.observations["observation"]
    mean, variance = (each[:, None, None].float() for each in (moments.mean, moments.variance))
    shown = state.clone()
    shown["observation"] = ((state["observation"] - mean) / (variance + 1e-8).sqrt()).clamp(
        -FARTHEST, FARTHEST
    )
    plain = agent.head(shown)
    found = agent(state.clone())
    unit = agent.normalization.returns.deviation[:, None, None, None]
    torch.testing.assert_close(found["logits"], plain["logits"])
    torch.testing.assert_close(found["state_value"], plain["state_value"] * unit)
    assert state["observation"][0, 0, 0, 0] == 1e6  # is not written over


def test_training_is_that_on_rewards_divided_by_the_unit() -> None:
    """Loss and gradient, clipped values included, are those of the rewards in that unit."""
    changed: dict[str, Any] = {
        "normalize_observations": False, "clip_value": 0.1, "normalize_advantage": False,
        "minibatches": 1, "epochs": 1,
    }  # fmt: skip
    _, scaled = made(**changed)
    _, plain = made(**changed, normalize_rewards=False)
    rollout = scaled.collect(generators(*range(K)))
    copied = rollout.clone()
    metrics = scaled.optimise(rollout)
    unit = scaled.agent.normalization.returns.deviation[:, None, None, None]
    assert not torch.allclose(unit, torch.ones(()), rtol=0.1)
    copied["next", "reward"] /= unit
    expected = plain.optimise(copied)
    for key, entry in expected.items():
        torch.testing.assert_close(metrics[key], entry, rtol=1e-4, atol=1e-5)
    for one, other in zip(scaled.agent.parameters(), plain.agent.parameters(), strict=True):
        torch.testing.assert_close(one.grad, other.grad, rtol=1e-3, atol=1e-6)


def test_only_training_moves_the_moments(trained: Any) -> None:
    """Evaluations, probes, gradients and what others watch read them as they are."""
    task, learner, _ = trained
    before = learner.snapshot()
    students = [TaskStudent(task, learner, k) for k in range(K)]
    levels = task.evaluated_on["target"][:2]
    task.measure(learner.agent)
    rollouts = [one.play(levels, g) for one, g in zip(students, generators(*range(K)), strict=True)]
    probes = torch.stack([student.probe(levels) for student in students])
    assert (learner.snapshot() == before).all()
    agent = learner.agent
    state: Any = torch.stack(rollouts)[:, :, 0]
    torch.testing.assert_close(probes, agent(state.clone())["logits"].softmax(-1))
    assert "normalization.returns.count" in before.keys()
    # A population that works out gradients of levels is shown what the Solver is.
    values: list[Any] = []

    def value(clones: Any, solver: int, which: Any) -> Any:
        shown = state[solver][which].select("observation").unsqueeze(1)
        values.append(clones(shown)["state_value"])
        return values[-1].flatten()

    LevelGradients(task).lengths(learner, value, K, 1)
    for k in range(K):
        expected = agent(state.clone())["state_value"][k, 0, 0]
        torch.testing.assert_close(values[k][0, 0, 0], expected)


def test_the_moments_belong_to_what_is_stored(trained: Any) -> None:
    task, learner, _ = trained
    fresh = task.learner([Streams(9)] * K)
    load_agent(fresh.agent, agent_weights(learner.agent))
    performances = [task.performance(a, task.evaluated_on["all"], torch.Generator().manual_seed(0))
                    for a in (learner.agent, fresh.agent)]  # fmt: skip
    assert (performances[0] == performances[1]).all()
    fresh.restore(learner.snapshot())
    assert (fresh.snapshot() == learner.snapshot()).all()

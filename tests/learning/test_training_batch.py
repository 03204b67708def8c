"""Minibatches, annealing and the clipped value loss, against the batch as a whole and formulas."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs import GymEnv

from proposer_rl.learning import PPO, PPOSettings
from proposer_rl.models import ActorCritic
from proposer_rl.settings import ArgumentError
from tests.draws import generators
from tests.learning import test_memory, test_ppo

K = 2
SETTINGS = PPOSettings(horizon=12, epochs=2, minibatches=3, learning_rate=1e-2, clip_value=0.2)


def of_maze(settings: PPOSettings, per_step: bool, copies: int = K) -> PPO:
    return test_ppo.learner(copies, settings, observe_agent=per_step)


def remembering(settings: PPOSettings, copies: int = K, **how: bool) -> PPO:
    return test_memory.learner(range(copies), settings, **how)


KINDS: dict[str, Callable[..., PPO]] = {
    "steps": partial(of_maze, per_step=True),
    "levels": partial(of_maze, per_step=False),
    "memory": remembering,
    "memory, batched": partial(remembering, batched=True),
}


@pytest.fixture(params=KINDS)
def make(request: pytest.FixtureRequest) -> Callable[..., PPO]:
    return KINDS[request.param]


@pytest.mark.parametrize("minibatches", [1, 3])
def test_copies_together_train_as_each_alone(make: Callable[..., PPO], minibatches: int) -> None:
    """So copies may be spread over processes; their numbers differ by rounding alone."""
    settings = replace(SETTINGS, minibatches=minibatches)
    together = make(settings)
    start, levels = together.snapshot(), together.env.levels
    rollouts = [together.update(generators(*range(K))).rollout for _ in range(2)]
    for k in range(K):
        alone = make(settings, copies=1)
        alone.restore(start[[k]])
        alone.env.set_levels(levels[k : k + 1])
        for rollout in rollouts:
            own = alone.update(generators(k)).rollout
            for key in ("action", "advantage", ("next", "reward")):
                torch.testing.assert_close(own[key][0], rollout[key][k], rtol=1e-4, atol=1e-5)
        for name, entry in alone.snapshot().items():
            own, before = together.snapshot()[name, "value"][k], start[name, "value"][k]
            torch.testing.assert_close(own, entry["value"][0], rtol=1e-4, atol=1e-5)
            assert not torch.allclose(own, before, rtol=1e-3, atol=1e-4)


def parts(ppo: PPO, rollout: TensorDict) -> list[TensorDict]:
    """Of the first epoch, each with its level's entries where an encoder reads them."""
    level = rollout.select(*ppo.agent.level_keys)[..., 0]
    order = ppo._minibatches.draw(generators(*range(K)))["order_0_0"]
    return [some for some, _ in ppo._minibatches(rollout, level, order)]


def test_each_step_is_in_one_part_of_its_own_replica(make: Callable[..., PPO]) -> None:
    ppo = make(replace(SETTINGS, minibatches=2))
    rollout = ppo.collect(generators(*range(K)))
    number = torch.arange(rollout.numel()).reshape(*rollout.shape, 1)
    rollout.set("advantage", number)
    drawn = [part["advantage"].flatten(1) for part in parts(ppo, rollout)]
    assert not torch.equal(torch.cat(drawn, 1), number.flatten(1))
    assert torch.equal(torch.cat(drawn, 1).sort().values, number.flatten(1))


def test_one_shuffled_part_gives_the_gradient_of_the_whole_batch(make: Callable[..., PPO]) -> None:
    ppo = make(replace(SETTINGS, minibatches=1))
    rollout = ppo.update(
        generators(*range(K))
    ).rollout  # the policy has moved on from the one that acted
    rollout.set("acted_value", rollout["state_value"])
    level = rollout.select(*ppo.agent.level_keys)[..., 0]
    start, metrics, gradients = ppo.snapshot(), [], []
    orders = torch.stack([torch.randperm(ppo._minibatches._count) for _ in range(K)])
    for order in (None, orders):
        ppo.restore(start)
        (part,) = ppo._minibatches(rollout, level, order)
        metrics.append(ppo._gradient_step(*part))
        gradients.append([p.grad.clone() for p in ppo.agent.parameters() if p.grad is not None])
    torch.testing.assert_close(metrics[0].to_dict(), metrics[1].to_dict(), rtol=1e-4, atol=1e-5)
    for whole, shuffled in zip(*gradients, strict=True):
        torch.testing.assert_close(whole, shuffled, rtol=1e-3, atol=1e-5)


def test_a_single_agent_in_a_single_environment_trains_on_minibatches() -> None:
    layer = TensorDictModule(torch.nn.Linear(4, 3), ["observation"], ["outputs"])
    split = TensorDictModule(lambda x: x.split([2, 1], -1), ["outputs"], ["logits", "state_value"])
    env = GymEnv("CartPole-v1", categorical_action_encoding=True)
    ppo = PPO(env, ActorCritic(TensorDictSequential(layer, split)), SETTINGS)
    before = layer.module.weight.detach().clone()
    rollout, metrics = ppo.update()
    assert rollout["advantage"].shape == (SETTINGS.horizon, 1) and metrics["grad_norm"].isfinite()
    assert not torch.equal(before, layer.module.weight)
    assert {float(each["step"]) for each in ppo.snapshot().values()} == {6.0}


@pytest.mark.parametrize(
    ("name", "value", "per_step", "why"),
    [
        ("minibatches", 7, False, "must be at most the 6 sequences of"),
        ("minibatches", 73, True, "must be at most the 72 steps of"),
        ("continue_episodes", True, False, "this Solver reads its level once"),
        ("normalize_observations", True, False, "this Solver reads its level once"),
        ("normalize_rewards", True, False, "this Solver reads its level once"),
    ],
)
def test_settings_that_a_solver_cannot_follow_are_refused(
    name: str, value: Any, per_step: bool, why: str
) -> None:
    with pytest.raises(ArgumentError, match=f"^{name}={value}: {why}"):
        of_maze(replace(SETTINGS, **{"minibatches": 1, name: value}), per_step)


def test_the_learning_rate_falls_to_zero_in_equal_steps() -> None:
    """Also of a learner that a snapshot was put into; then nothing is learnt any more."""
    settings = replace(SETTINGS, anneal_updates=4, updates=2, normalize_advantage=False)
    ppo = of_maze(settings, True)
    rates = []
    for update in range(6):
        ppo.update(generators(*range(K)))
        rates.append(ppo._adam.param_groups[0]["lr"])
        if update == 1:
            ppo.restore(ppo.snapshot())
            fresh = of_maze(settings, True)
            fresh.restore(ppo.snapshot())
            assert fresh.learning_rate == ppo.learning_rate
    assert rates == pytest.approx([1e-2 * share for share in (1, 0.75, 0.5, 0.25, 0, 0)])
    before = ppo.snapshot()
    ppo.update(generators(*range(K)))
    for name, entry in ppo.snapshot().items():
        assert torch.equal(entry["value"], before[name, "value"])


def test_the_learning_rate_falls_on_where_the_first_parameters_are_frozen() -> None:
    ppo = of_maze(replace(SETTINGS, anneal_updates=4), True)
    next(ppo.agent.parameters()).requires_grad_(False)
    ppo.update(generators(*range(K)))
    ppo.restore(ppo.snapshot())
    assert ppo.left == 0.75


def test_the_clip_falls_with_the_learning_rate() -> None:
    settings = replace(SETTINGS, anneal_updates=4, clip_epsilon=0.01, learning_rate=0.1)
    annealed = of_maze(replace(settings, anneal_clip=True), True)
    annealed.update(generators(*range(K)))
    halved = of_maze(replace(settings, clip_epsilon=0.0075), True)
    halved.restore(annealed.snapshot())
    kept = of_maze(settings, True)
    kept.restore(annealed.snapshot())
    weights = []
    for ppo in (annealed, halved, kept):
        ppo.update(generators(*range(K)))
        weights.append(ppo.snapshot())
    for name, entry in weights[0].items():
        torch.testing.assert_close(entry["value"], weights[1][name, "value"])
    assert any(not torch.equal(e["value"], weights[2][n, "value"]) for n, e in weights[0].items())


def test_a_clipped_value_loss_is_the_larger_error() -> None:
    """Of the value, and of the value moved from the old one by at most a little."""
    bound = 1e-3
    ppo = of_maze(replace(SETTINGS, minibatches=1, clip_value=bound), True)
    rollout = ppo.update(generators(*range(K))).rollout
    rollout.set("acted_value", rollout["state_value"])
    level = rollout.select(*ppo.agent.level_keys)[..., 0]
    with torch.no_grad():
        value = ppo.agent(rollout.copy())["state_value"]
    old, target = rollout["state_value"], rollout["value_target"]
    near = torch.maximum(torch.minimum(value, old + bound), old - bound)
    errors = torch.stack([(value - target).square(), (near - target).square()])
    assert (errors[1] > errors[0]).any() and (errors[0] > errors[1]).any()
    expected = ppo.settings.critic_coeff * errors.amax(0).mean((1, 2, 3))
    found = ppo._gradient_step(rollout, level)["loss_critic"]
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)

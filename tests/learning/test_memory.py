"""PPO of Solvers with memory: sequences, copies together and apart, and TorchRL's own rollouts."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.modules import set_recurrent_mode

from proposer_rl.learning import PPO, PPOSettings
from proposer_rl.learning.rollout import set_values
from proposer_rl.meta.first_order import surrogate
from proposer_rl.models import Population, memory_actor_critic
from proposer_rl.tasks.view_mazes import view_env
from tests.draws import generators
from tests.tasks.view_mazes.oracles import random_levels

K, P, T, M = 2, 3, 14, 8
SETTINGS = PPOSettings(horizon=T, epochs=3, learning_rate=1e-2)


def learner(copies: range = range(K), settings: PPOSettings = SETTINGS, **how: Any) -> PPO:
    seeds = iter(copies)

    def make() -> torch.nn.Module:
        torch.manual_seed(next(seeds))
        return view_env.view_network(view_env.ViewNetworkSettings(channels=4, memory=M, head=8))

    population = Population(make, len(copies), **how)
    agent = memory_actor_critic(population, view_env.VIEW_ENTRIES, M)
    levels = random_levels(K * P, side=5).reshape(K, P)[list(copies)]
    return PPO(view_env.ViewMazeEnv(levels, max_steps=6), agent, settings)


def through_time(ppo: PPO, rollout: TensorDict) -> TensorDict:
    with set_recurrent_mode(True), torch.no_grad():
        return ppo.agent(rollout.clone())


def test_training_starts_from_the_probabilities_that_acted() -> None:
    ppo = learner()
    rollout = ppo.collect(generators(*range(K)))
    assert rollout["is_init"][:, :, 1:].any()
    again = through_time(ppo, rollout)
    log_prob = ppo.agent.distribution(again).log_prob(rollout["action"])
    torch.testing.assert_close(log_prob, rollout["action_log_prob"], rtol=0, atol=1e-5)
    torch.testing.assert_close(again["state_value"], rollout["state_value"], rtol=0, atol=1e-5)
    level = rollout.select(*ppo.agent.level_keys)[..., 0]
    first = ppo.train(TensorDict({"steps": rollout, "level": level}))["gradient_steps"][0]
    assert first["kl_approx"].tolist() == pytest.approx([0] * K, abs=1e-6)
    assert first["clip_fraction"].tolist() == [0] * K


def test_values_after_a_step_are_those_before_the_next_one() -> None:
    rollout = learner().collect(generators(*range(K)))
    going_on = ~rollout["next", "done"][:, :, :-1]
    before, after = rollout["state_value"][:, :, 1:], rollout["next", "state_value"][:, :, :-1]
    torch.testing.assert_close(before[going_on], after[going_on], rtol=1e-5, atol=1e-6)
    truncated = rollout["next", "truncated"][:, :, :-1]
    assert not torch.allclose(before[truncated], after[truncated], atol=1e-4)


def test_a_second_look_at_a_rollout_remembers_with_the_present_weights() -> None:
    ppo = learner()
    rollout = ppo.collect(generators(*range(K)))
    ppo.optimise(rollout)
    steps = rollout.clone()
    set_values(ppo.agent, steps, TensorDict({}, [K, P]))
    fresh = through_time(ppo, rollout)
    torch.testing.assert_close(steps["state_value"], fresh["state_value"])
    assert not torch.allclose(steps["state_value"], rollout["state_value"])
    memory = ("next", "recurrent_state_h")
    torch.testing.assert_close(steps[memory], fresh[memory])


def test_a_policys_gradient_goes_through_time() -> None:
    """That of the surrogate is that of a loop over the steps, each with the memory before it."""
    ppo = learner()
    agent, rollout = ppo.agent, ppo.collect(generators(*range(K)))
    advantage = torch.randn(K, P, T, generator=torch.Generator().manual_seed(0))
    parameters = list(agent.parameters())
    found = torch.autograd.grad(surrogate(agent, rollout, advantage).sum(), parameters)
    memory, worth = agent.no_memory(rollout[:, :, 0]), torch.zeros(())
    for t in range(T):
        step = agent(rollout[:, :, t].clone().update(memory))
        log_prob = agent.distribution(step).log_prob(step["action"])
        worth = worth + (advantage[:, :, t] * log_prob).sum()
        memory = step["next"].select(*agent.memory)
    expected = torch.autograd.grad(worth / T, parameters, allow_unused=True)
    for gradient, other in zip(found, expected, strict=True):
        other = torch.zeros_like(gradient) if other is None else other
        torch.testing.assert_close(gradient, other, rtol=1e-4, atol=1e-6)

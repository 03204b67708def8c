"""The level's context computed once gives the numbers of a forward pass per transition."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torch.distributions import Categorical, Normal

from proposer_rl import models
from proposer_rl.models.grids import read_maps
from tests.draws import generators

K, P, T, H, W = 2, 3, 5, 6, 7


def solver(per_step: bool = False):
    def make() -> models.UNet:
        return models.UNet(in_channels=4 if per_step else 3, channels=(8, 16), groups=4)

    return models.map_actor_critic(models.Population(make, K), per_step=per_step)


def rollout(channels: int = 3) -> TensorDict:
    planes = torch.rand(K, P, 1, channels, H, W).expand(K, P, T, channels, H, W)
    agent = torch.stack([torch.randint(H, (K, P, T)), torch.randint(W, (K, P, T))], -1)
    return TensorDict({"planes": planes, "agent": agent}, [K, P, T])


@pytest.mark.parametrize("per_step", [False, True])
def test_decoding_a_context_equals_a_pass_per_transition(per_step: bool) -> None:
    agent, steps = solver(per_step), rollout(4 if per_step else 3)
    assert bool(agent.level_keys) != per_step  # where each step has its own, nothing is shared
    slow = agent(steps.clone())
    shown = steps.clone() if per_step else steps.select("agent")
    fast = agent.decode(shown, agent.encode(steps[..., 0]))
    assert fast["logits"].shape == (K, P, T, 4)
    for key in ("logits", "state_value"):
        torch.testing.assert_close(fast[key], slow[key], rtol=1e-4, atol=1e-5)


def test_a_network_without_copies_is_an_ordinary_actor() -> None:
    agent = models.map_actor_critic(models.UNet(channels=(8, 16), groups=4))
    assert agent.copies is None
    step = rollout()[0, :, 0]
    result = agent.actor()(step)
    assert result["action"].shape == result["action_log_prob"].shape == (P,)


@pytest.mark.parametrize("extra", [(), (T,), (T, 2)])
def test_read_maps_indexes_the_agents_cell(extra: tuple[int, ...]) -> None:
    policy, value = torch.rand(K, P, 4, H, W), torch.rand(K, P, 1, H, W)
    shape = (K, P, *extra)
    agent = torch.stack([torch.randint(H, shape), torch.randint(W, shape)], -1)
    logits, values = read_maps(policy, value, agent)
    assert logits.shape == (*shape, 4) and values.shape == (*shape, 1)
    for index in torch.cartesian_prod(*map(torch.arange, shape)).tolist():
        k, p = index[:2]
        row, column = agent[tuple(index)].tolist()
        assert torch.equal(logits[tuple(index)], policy[k, p, :, row, column])
        assert torch.equal(values[tuple(index)], value[k, p, :, row, column])


@pytest.mark.parametrize("per_step", [False, True])
def test_cell_maps_are_what_the_solver_says_at_each_cell(per_step: bool) -> None:
    agent = solver(per_step)
    planes = torch.rand(K, P, 3, H, W)
    logits, values = models.cell_maps(agent, planes)
    assert torch.equal(models.cell_logits(agent, planes), logits) and values.shape == (
        K,
        P,
        1,
        H,
        W,
    )
    for row, column in [(0, 0), (2, 5), (H - 1, W - 1)]:
        shown = planes
        if per_step:
            drawn = torch.zeros(K, P, 1, H, W)
            drawn[..., row, column] = 1
            shown = torch.cat([planes, drawn], 2)
        at = torch.tensor([row, column]).expand(K, P, 2)
        step = agent(TensorDict({"planes": shown, "agent": at}, [K, P]))
        for maps, key in ((logits, "logits"), (values, "state_value")):
            torch.testing.assert_close(maps[..., row, column], step[key], rtol=1e-4, atol=1e-5)


@given(
    st.lists(st.floats(-5, 5), min_size=2, max_size=6), st.floats(0, 1, exclude_max=True, width=32)
)
def test_draw_inverts_the_cumulative_distribution(logits: list[float], uniform: float) -> None:
    distribution = models.categorical(torch.tensor(logits, dtype=torch.float64))
    action = int(models.draw_at(distribution, torch.tensor(uniform, dtype=torch.float64)))
    cumulative = distribution.probs.cumsum(0)
    below = float(cumulative[action - 1]) if action else 0.0
    assert below <= uniform + 1e-12 and uniform <= float(cumulative[action]) + 1e-12


def test_draw_never_takes_an_impossible_action() -> None:
    probabilities = torch.tensor([0.0, 0.5, 0.0, 0.5, 0.0])
    edges = torch.tensor([0.0, 0.25, 0.5, 1 - 2**-24])
    actions = models.draw_at(Categorical(probs=probabilities.expand(4, 5)), edges)
    assert actions.tolist() == [1, 1, 3, 3]


def test_draw_sees_through_independence_and_takes_other_distributions() -> None:
    logits, noise = torch.randn(3, 5, 4), torch.rand(3, 5)
    assert torch.equal(
        models.draw_at(models.joint_categorical(logits), noise),
        models.draw_at(models.categorical(logits), noise),
    )
    assert models.draw_at(Normal(torch.zeros(1), 1.0), torch.tensor([0.5])).item() == pytest.approx(
        0.0
    )


def test_noise_of_a_copy_depends_on_its_generator_alone() -> None:
    device = torch.device("cpu")
    both = models.uniform_noise(torch.Size([2, 3]), 4, generators(5, 6), device)
    alone = models.uniform_noise(torch.Size([1, 3]), 4, generators(6), device)
    assert both.shape == (4, 2, 3)
    assert torch.equal(both[:, 1:], alone)

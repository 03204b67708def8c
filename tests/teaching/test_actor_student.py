"""A plain actor and critic of TorchRL's under first-order gain, against gradients by hand."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Categorical
from torchrl.modules import ProbabilisticActor, ValueOperator

import proposer_rl as prl
from proposer_rl.teaching.results import ended

SPACE = prl.Parameters({"arm": [0, 1]}, target={"arm": 1})


def bandits(adam: bool) -> tuple[Any, Any, Any]:
    """A linear policy over the two levels, which are seen as they are."""
    torch.manual_seed(0)
    actor = ProbabilisticActor(
        TensorDictModule(nn.Linear(2, 2, bias=False), ["observation"], ["logits"]),
        in_keys=["logits"],
        distribution_class=Categorical,
    )
    critic = ValueOperator(nn.Linear(2, 1), ["observation"])
    kind = torch.optim.Adam if adam else torch.optim.SGD
    optimizer = kind(actor.parameters(), lr=1e-3)
    for _ in range(3 if adam else 0):
        torch.randn(2, 2).mul(next(actor.parameters())).sum().backward()
        optimizer.step()
    return actor, critic, optimizer


def play(actor: Any, levels: Any, generator: torch.Generator) -> TensorDict:
    """One step on each level: the reward is 1 where the action is the level."""
    seen = nn.functional.one_hot(levels["arm"], 2).float().unsqueeze(1)  # [n, 1, 2]
    with torch.no_grad():
        chance = actor.get_dist(TensorDict({"observation": seen}, seen.shape[:2])).probs
    action = torch.multinomial(chance[:, 0], 1, generator=generator)
    over = torch.ones(*seen.shape[:2], 1, dtype=torch.bool)
    reward = (action == levels["arm"].unsqueeze(1)).float().unsqueeze(-1)
    after = {"observation": seen, "reward": reward, "done": over, "terminated": over}
    entries = {"observation": seen, "action": action, "next": after}
    return TensorDict(entries, seen.shape[:2], names=[None, "time"])


def student(adam: bool) -> tuple[prl.ActorStudent, Any, Any]:
    actor, critic, optimizer = bandits(adam)
    return prl.ActorStudent(actor, critic, optimizer), actor, optimizer


@pytest.mark.parametrize("adam", [True, False])
def test_direction_and_alignment_are_those_of_gradients_by_hand(adam: bool) -> None:
    taught, actor, optimizer = student(adam)
    levels = SPACE.given(SPACE.sample(64, torch.Generator().manual_seed(0)))
    rollout = play(actor, levels, torch.Generator().manual_seed(1)).unsqueeze(0)
    weights = torch.rand(1, 64, generator=torch.Generator().manual_seed(2))
    weight = next(actor.parameters())

    def mean_log_prob(advantage: torch.Tensor) -> torch.Tensor:
        logits = (rollout["observation"] @ weight.T).log_softmax(-1)
        chosen = logits.gather(-1, rollout["action"].unsqueeze(-1)).squeeze(-1)
        return advantage * chosen

    with torch.no_grad():
        value = taught._critic(rollout.copy())["state_value"].squeeze(-1)
    advantage = rollout["next", "reward"].squeeze(-1) - value
    weighted = (mean_log_prob(advantage).mean(-1) * weights).sum()
    (gradient,) = torch.autograd.grad(weighted, weight)
    if adam:
        state = optimizer.state[weight]
        gradient = gradient / ((state["exp_avg_sq"] / (1 - 0.999**3)).sqrt() + 1e-8)
    direction = taught.sampled_direction(rollout, weights)
    (found,) = (entry[0] for entry in direction.values())
    torch.testing.assert_close(found, gradient, rtol=1e-4, atol=1e-5)
    before = weight.detach().clone()
    slope = taught.sampled_alignment(direction, rollout)["slope"]
    each = [
        (torch.autograd.grad(mean_log_prob(advantage)[0, i].mean(), weight)[0] * found).sum()
        for i in range(4)
    ]
    torch.testing.assert_close(slope[0, :4], torch.stack(each), rtol=1e-2, atol=1e-3)
    assert weight.equal(before)


def test_parameters_that_are_frozen_or_of_another_head_do_not_matter() -> None:
    taught, actor, _ = student(adam=False)
    levels = SPACE.given(SPACE.sample(8, torch.Generator().manual_seed(0)))
    rollout = play(actor, levels, torch.Generator().manual_seed(1)).unsqueeze(0)
    (expected,) = taught.sampled_direction(rollout, torch.ones(1, 8)).values()
    layer = next(module for module in actor.modules() if isinstance(module, nn.Linear))
    layer.head, layer.frozen = nn.Linear(2, 1), nn.Linear(2, 1).requires_grad_(False)
    found = taught.sampled_direction(rollout, torch.ones(1, 8))
    assert [bool(entry.any()) for entry in found.values()] == [True, False, False]
    assert next(iter(found.values())).equal(expected)
    assert taught.sampled_alignment(found, rollout)["slope"].shape == (1, 8)


def test_first_order_gain_finds_the_levels_of_the_target() -> None:
    taught, actor, _ = student(adam=True)
    recipe = prl.curricula.first_order_sampled(smoothing=0.5, exploration=0.2)
    teacher = prl.Teacher(recipe, SPACE, student=taught)
    share = []
    for update in range(8):
        levels = teacher.propose(64)
        share.append(float((levels["arm"] == 1).float().mean()))
        rollout = play(actor, levels, torch.Generator().manual_seed(update))
        teacher.observe(prl.outcome_of(rollout))
    assert sum(share[4:]) / 4 > 0.8


def test_what_lies_behind_an_episode_counts_nowhere() -> None:
    """Of episodes cut out of a rollout: those of other lengths beside it change nothing."""
    taught, _, _ = student(adam=False)
    draws = torch.Generator().manual_seed(3)
    over = torch.tensor([[0, 1, 0, 0, 0, 1], [0, 0, 0, 1, 0, 1]]).bool().unsqueeze(-1)
    numbers = torch.tensor([[1, 1, 2, 2, 2, 2], [3, 3, 3, 3, 4, 4]])
    seen = torch.randn(2, 7, 2, generator=draws)
    after = {"observation": seen[:, 1:], "reward": torch.randn(2, 6, 1, generator=draws)}
    after |= {"done": over, "terminated": over}
    entries = {"observation": seen[:, :-1], "next": after, "level_id": numbers}
    entries["action"] = torch.randint(2, (2, 6), generator=draws)
    rollout = TensorDict(entries, [2, 6], names=[None, "time"])
    ids, together, _ = ended(rollout)
    cuts = {1: rollout[:1, :2], 2: rollout[:1, 2:], 3: rollout[1:, :4], 4: rollout[1:, 4:]}
    alone = [cuts[number].unsqueeze(0) for number in ids.tolist()]
    assert prl.outcome_of(together)["steps"].tolist() == [[e.batch_size[-1] for e in alone]]
    direction = taught.sampled_direction(together, torch.ones(1, 4))
    each = [taught.sampled_direction(episode, torch.ones(1, 1)) for episode in alone]
    for name, entry in direction.items():
        torch.testing.assert_close(entry, torch.stack([d[name] for d in each]).sum(0))
    slopes = [taught.sampled_alignment(direction, episode)["slope"] for episode in alone]
    found = taught.sampled_alignment(direction, together)["slope"]
    torch.testing.assert_close(found, torch.cat(slopes, 1), rtol=1e-3, atol=1e-3)

"""Batched environments step by step against plain Python, and their chances against SplitMix64."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs import check_env_specs

from proposer_rl.models import population
from proposer_rl.tasks.batched_envs import BatchedEnv, finalized, uniform
from tests.tasks.batched_envs.toys import StillEnv, WindyEnv

MASK, GAMMA = 2**64 - 1, 0x9E3779B97F4A7C15


def winds(*winds: float, seeds: tuple[int, ...] | None = None) -> TensorDict:
    level = {"wind": torch.tensor(winds), "seed": torch.tensor(seeds or range(len(winds)))}
    return TensorDict(level, [len(winds)])


def firsts(*firsts: int) -> TensorDict:
    return TensorDict({"first": torch.tensor(firsts)}, [len(firsts)])


def signed(x: int) -> int:
    return (x & MASK) - (2**64 if x & 2**63 else 0)


def in_python(x: int) -> int:
    """SplitMix64's finalizer with the numbers of its publication."""
    x &= MASK
    x = ((x ^ (x >> 30)) * 0xBF58476D1CE4E5B9) & MASK
    x = ((x ^ (x >> 27)) * 0x94D049BB133111EB) & MASK
    return x ^ (x >> 31)


def chance(seed: int, step: int, place: int) -> float:
    """The number at a place of a step, from 0 on."""
    x = in_python(in_python(seed) + step * GAMMA) + (place + 1) * 0x632BE59BD9B4E019
    return (in_python(x) >> 40) / 2**24


def test_the_finalizer_is_that_of_splitmix64() -> None:
    """The generator's published first numbers, which are finalized multiples of its gamma."""
    counted = [signed(1234567 + (i + 1) * GAMMA) for i in range(3)]
    published = [6457827717110365317, 3203168211198807973, 9817491932198370423]
    assert finalized(torch.tensor(counted)).tolist() == [signed(x) for x in published]
    some = torch.randint(-(2**63), 2**63 - 1, (200,))
    assert finalized(some).tolist() == [signed(in_python(x)) for x in some.tolist()]


def test_chances_are_uniform_and_know_nothing_of_each_other() -> None:
    """In mean, variance, tails and bins; between seeds, steps and places that follow each other."""
    seeds, steps, count = 300, 40, 6
    seed, step = torch.meshgrid(torch.arange(seeds), torch.arange(steps), indexing="ij")
    drawn = uniform(seed.unsqueeze(-1), step.unsqueeze(-1), count).double()
    assert drawn.shape == (seeds, steps, count) and drawn.min() >= 0 and drawn.max() < 1
    deviation = drawn.numel() ** -0.5
    assert abs(float(drawn.mean()) - 1 / 2) < 4 * deviation * 12**-0.5
    assert abs(float(drawn.var()) - 1 / 12) < 4 * deviation * 180**-0.5
    for along in range(3):
        for size in (1, 2):
            ahead = drawn.narrow(along, size, drawn.shape[along] - size)
            behind = drawn.narrow(along, 0, drawn.shape[along] - size)
            both = torch.stack([ahead.flatten(), behind.flatten()])
            assert abs(float(both.corrcoef()[0, 1])) < 4 * ahead.numel() ** -0.5
            pairs = torch.histc((both[0] * 16).floor() * 16 + (both[1] * 16).floor(), 256, 0, 256)
            wanted = both.shape[1] / 256
            # Chi-squared with 255 degrees of freedom is below 370 but for once in 300,000.
            assert float(((pairs - wanted) ** 2 / wanted).sum()) < 370
    repeated = drawn.numel() - len(drawn.unique())
    assert repeated < 2 * drawn.numel() ** 2 / 2 / 2**24  # as many as among random numbers


def test_chances_are_functions_of_seed_and_step() -> None:
    largest = torch.tensor([[2**31 - 1], [0], [7]])
    step = torch.tensor([[0], [5], [99]])
    drawn = uniform(largest, step, 3)
    pairs = zip(largest.tolist(), step.tolist(), strict=True)
    wanted = [[chance(a, b, i) for i in range(3)] for [a], [b] in pairs]
    assert drawn.tolist() == wanted
    assert torch.equal(uniform(largest.flip(0), step.flip(0), 3), drawn.flip(0))
    assert torch.equal(uniform(largest, step, 5)[:, :3], drawn)


def test_steps_are_those_of_plain_python() -> None:
    levels = winds(0.5, 2.0, 0.1, seeds=(3, 4, 5))
    env, limit = WindyEnv(levels, max_steps=6), 6
    state = env.reset()
    places = [chance(seed, 0, 0) for seed in (3, 4, 5)]
    for step in range(1, limit + 1):
        assert state["state"].squeeze(-1).tolist() == pytest.approx(places)
        seen = [[place, wind] for place, wind in zip(places, (0.5, 2.0, 0.1), strict=True)]
        assert torch.allclose(state["observation"], torch.tensor(seen))
        action = torch.tensor([[2.5], [0.0], [-0.3]])  # of which the first is clipped
        after = env.step(state.set("action", action))["next"]
        for i, (wind, seed) in enumerate(zip((0.5, 2.0, 0.1), (3, 4, 5), strict=True)):
            places[i] += min(float(action[i]), 1) + wind * chance(seed, step, 1)
            last, ended = step == limit, places[i] > 3
            assert float(after["reward"][i]) == pytest.approx(-abs(places[i]), abs=1e-5)
            assert bool(after["terminated"][i]) == ended
            assert bool(after["truncated"][i]) == (last and not ended)
            assert bool(after["done"][i]) == (last or ended)
            assert bool(after["success"][i]) == (places[i] > 2 and (last or ended))
            if ended:
                places[i] = chance(seed, 0, 0)
        state = env.reset(after.exclude("reward").set("_reset", after["terminated"]))
        if after["terminated"].any():
            break
    assert step < limit, "none of them has got to the end"


@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
@pytest.mark.parametrize("make", [WindyEnv, StillEnv])
def test_torchrl_finds_nothing_wrong(make: type[BatchedEnv], shape: tuple[int, ...]) -> None:
    level = {"wind": torch.ones(shape), "first": torch.ones(shape, dtype=torch.int64)}
    levels = TensorDict({**level, "seed": torch.zeros(shape, dtype=torch.int64)}, shape)
    check_env_specs(make(levels, max_steps=4), break_when_any_done="both")


def test_new_levels_begin_with_the_next_reset_of_each() -> None:
    env, act = StillEnv(firsts(0, 10)), torch.ones(2, dtype=torch.int64)
    windy = WindyEnv(winds(1.0, 1.0))
    state = env.step(env.reset().set("action", act))["next"].exclude("reward")
    blown = windy.reset()
    env.set_levels(firsts(20, 30))
    windy.set_levels(winds(0.0, 0.0, seeds=(8, 9)))
    state = env.reset(state.set("_reset", torch.tensor([[False], [True]])))
    assert state["observation"].flatten().tolist() == [1, 30]
    assert state["is_init"].flatten().tolist() == [False, True]
    assert state["step_count"].flatten().tolist() == [1, 0]
    blown = windy.reset(blown.set("_reset", torch.tensor([[False], [True]])))
    after = windy.step(blown.set("action", torch.zeros(2, 1)))["next"]
    assert after["observation"][:, 1].tolist() == [1.0, 0.0]
    assert float(after["state"][0]) == pytest.approx(chance(0, 0, 0) + chance(0, 1, 1))
    assert float(after["state"][1]) == pytest.approx(chance(9, 0, 0))
    assert windy.reset()["observation"][:, 1].tolist() == [0.0, 0.0]


def test_levels_are_its_own() -> None:
    levels = firsts(1, 2)
    env = StillEnv(levels)
    levels["first"].fill_(9)
    assert env.reset()["observation"].flatten().tolist() == [1, 2]


class Pushed(nn.Module):
    def forward(self, tensordict: TensorDict) -> TensorDict:
        return tensordict.set("action", torch.rand(*tensordict.batch_size, 1) * 2 - 0.5)


def test_on_a_gpu_finished_episodes_begin_again_without_a_look(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As TorchRL's own resets, which ask the device first; on the levels that are set by then."""
    rollouts = []
    for at_hand in (True, False):
        monkeypatch.setattr(population, "at_hand", lambda _, answer=at_hand: answer)
        env = WindyEnv(winds(0.0, 1.0, 2.0), max_steps=5)
        torch.manual_seed(0)
        first = env.rollout(7, break_when_any_done=False, policy=Pushed())
        env.set_levels(winds(2.0, 0.0, 1.0, seeds=(7, 8, 9)))
        going = env.maybe_reset(first[:, -1]["next"].exclude("reward"))
        more = env.rollout(
            30, Pushed(), break_when_any_done=False, auto_reset=False, tensordict=going
        )
        rollouts.append(torch.cat([first, more], 1))
    assert (rollouts[0] == rollouts[1]).all()
    assert rollouts[0]["next", "terminated"].any() and rollouts[0]["next", "truncated"].any()
    played = rollouts[0]["observation"][..., 1]
    assert played[:, 7].tolist() == [0.0, 1.0, 2.0] and played[:, -1].tolist() == [2.0, 0.0, 1.0]

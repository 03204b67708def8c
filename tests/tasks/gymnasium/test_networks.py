"""The network fits what is seen and done, and copies of it learn by themselves."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces

from proposer_rl.models import Population, draw, normal
from proposer_rl.tasks.gymnasium.networks import SolverNetwork, checked_spaces
from proposer_rl.tasks.gymnasium.settings import NetworkSettings

SETTINGS = NetworkSettings(hidden=[16, 8], channels=[4, 6])
NUMBERS = spaces.Box(-1, 1, (5,))
FOUR = spaces.Discrete(4)
TWO = spaces.Box(-1, 1, (2,))


def images(side: int) -> spaces.Box:
    return spaces.Box(0, 255, (side, side + 1, 3), np.uint8)


@pytest.mark.parametrize("seen", [NUMBERS, images(7), images(40)], ids=str)
@pytest.mark.parametrize(("acts", "shape"), [(FOUR, (4,)), (TWO, (2, 2))])
def test_any_batch_goes_in(seen: Any, acts: Any, shape: tuple[int, ...]) -> None:
    network = SolverNetwork(seen, acts, SETTINGS)
    one = torch.as_tensor(np.stack([seen.sample() for _ in range(6)]))
    logits, value = network(one)
    assert logits.shape == (6, *shape) and value.shape == (6, 1)
    both = network(one.unflatten(0, (2, 3)))
    torch.testing.assert_close(both[0].flatten(0, 1), logits)
    torch.testing.assert_close(both[1].flatten(0, 1), value)


@pytest.mark.parametrize("seen", [NUMBERS, images(9)], ids=str)
@pytest.mark.parametrize("batched", [True, False])
def test_copies_are_networks_of_their_own(seen: Any, batched: bool) -> None:
    alone = [SolverNetwork(seen, TWO, SETTINGS) for _ in range(3)]
    made = iter([SolverNetwork(seen, TWO, SETTINGS) for _ in range(3)])
    population = Population(lambda: next(made), 3, batched=batched)
    for index, name in enumerate(population.names):
        for copy, network in enumerate(alone):
            population.stacked[index].data[copy] = dict(network.named_parameters())[name]
    observed = torch.as_tensor(np.stack([seen.sample() for _ in range(12)])).unflatten(0, (3, 4))
    for copy, network in enumerate(alone):
        for ours, its in zip(population(observed), network(observed[copy]), strict=True):
            torch.testing.assert_close(ours[copy], its, atol=1e-5, rtol=1e-5)


def test_bytes_are_scaled_and_numbers_are_not() -> None:
    black, white = torch.zeros(1, 7, 8, 3, dtype=torch.uint8), torch.full((1, 7, 8, 3), 255)
    network = SolverNetwork(images(7), FOUR, SETTINGS)
    scaled = SolverNetwork(
        spaces.Box(0, 1, (7, 8, 3)), FOUR, NetworkSettings(hidden=[16, 8], channels=[4, 6])
    )
    scaled.load_state_dict(network.state_dict())
    torch.testing.assert_close(network(white)[1], scaled(torch.ones(1, 7, 8, 3))[1])
    torch.testing.assert_close(network(black)[1], scaled(torch.zeros(1, 7, 8, 3))[1])
    half = SolverNetwork(NUMBERS, FOUR, NetworkSettings(hidden=[8], channels=[4], scale=0.5))
    whole = SolverNetwork(NUMBERS, FOUR, NetworkSettings(hidden=[8], channels=[4]))
    whole.load_state_dict(half.state_dict())
    seen = torch.rand(3, 5)
    torch.testing.assert_close(half(seen)[0], whole(seen / 2)[0])


def test_the_first_policies_are_wide() -> None:
    seen = torch.as_tensor(np.stack([NUMBERS.sample() for _ in range(50)]))
    even = SolverNetwork(NUMBERS, FOUR, SETTINGS)(seen)[0].softmax(-1)
    assert ((even - 0.25).abs() < 0.02).all()
    distribution = normal(SolverNetwork(NUMBERS, TWO, SETTINGS)(seen)[0])
    drawn = draw(distribution, torch.rand(50, 2))
    assert drawn.shape == (50, 2) and 0.4 < drawn.std() < 0.8


@pytest.mark.parametrize(
    ("seen", "acts", "message"),
    [
        (spaces.Discrete(16), FOUR, r"observation space Discrete\(16\): .*FlattenObservation"),
        (spaces.Dict({"a": NUMBERS}), FOUR, "observation space Dict.*FlattenObservation"),
        (spaces.Box(0, 1, (4, 4)), FOUR, "observation space Box"),
        (NUMBERS, spaces.MultiBinary(3), "action space MultiBinary"),
        (NUMBERS, spaces.Box(0, 1, (2, 2)), "action space Box"),
    ],
)
def test_other_spaces_are_refused(seen: Any, acts: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        checked_spaces(seen, acts)

"""The network fits what is seen and done, and copies of it learn by themselves."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given
from hypothesis import settings as profile
from hypothesis import strategies as st
from torchrl.data import Categorical, MultiCategorical, TensorSpec, Unbounded

from proposer_rl.models import Population, draw_at, joint_categorical, normal
from proposer_rl.tasks.gymnasium.networks import NetworkSettings, SolverNetwork
from proposer_rl.tasks.gymnasium.spaces import Layout, cast_to, in_order
from tests.tasks.gymnasium.odd import Mixed

SETTINGS = NetworkSettings(hidden=[16, 8], channels=[4, 6])
NUMBERS, FOUR, TWO = Unbounded(5), Categorical(4), Unbounded(2)


def images(side: int) -> TensorSpec:
    return Unbounded((side, side + 1, 3), dtype=torch.uint8)


@pytest.mark.parametrize("seen", [NUMBERS, images(7), images(40)])
@pytest.mark.parametrize(("acts", "shape"), [(FOUR, (4,)), (TWO, (2, 2))])
def test_any_batch_goes_in(seen: Any, acts: Any, shape: tuple[int, ...]) -> None:
    network, one = SolverNetwork([seen], acts, SETTINGS), seen.rand([6])
    logits, value = network(one)
    assert logits.shape == (6, *shape) and value.shape == (6, 1)
    both = network(one.unflatten(0, (2, 3)))
    torch.testing.assert_close(both[0].flatten(0, 1), logits)
    torch.testing.assert_close(both[1].flatten(0, 1), value)


@pytest.mark.parametrize("seen", [NUMBERS, images(9)])
@pytest.mark.parametrize("batched", [True, False])
def test_copies_are_networks_of_their_own(seen: Any, batched: bool) -> None:
    alone = [SolverNetwork([seen], TWO, SETTINGS) for _ in range(3)]
    made = iter([SolverNetwork([seen], TWO, SETTINGS) for _ in range(3)])
    population = Population(lambda: next(made), 3, batched=batched)
    for index, name in enumerate(population.names):
        for copy, network in enumerate(alone):
            population.stacked[index].data[copy] = dict(network.named_parameters())[name]
    observed = seen.rand([3, 4])
    for copy, network in enumerate(alone):
        for ours, its in zip(population(observed), network(observed[copy]), strict=True):
            torch.testing.assert_close(ours[copy], its, atol=1e-5, rtol=1e-5)


def test_bytes_are_scaled_and_numbers_are_not() -> None:
    black, white = torch.zeros(1, 7, 8, 3, dtype=torch.uint8), torch.full((1, 7, 8, 3), 255)
    network = SolverNetwork([images(7)], FOUR, SETTINGS)
    scaled = SolverNetwork([Unbounded((7, 8, 3))], FOUR, SETTINGS)
    scaled.load_state_dict(network.state_dict())
    torch.testing.assert_close(network(white)[1], scaled(torch.ones(1, 7, 8, 3))[1])
    torch.testing.assert_close(network(black)[1], scaled(torch.zeros(1, 7, 8, 3))[1])
    half = SolverNetwork([NUMBERS], FOUR, NetworkSettings(hidden=[8], scale=0.5))
    whole = SolverNetwork([NUMBERS], FOUR, NetworkSettings(hidden=[8]))
    whole.load_state_dict(half.state_dict())
    seen = torch.rand(3, 5)
    torch.testing.assert_close(half(seen)[0], whole(seen / 2)[0])


def test_the_first_policies_are_wide() -> None:
    seen = 2 * torch.rand(50, 5) - 1
    even = SolverNetwork([NUMBERS], FOUR, SETTINGS)(seen)[0].softmax(-1)
    assert ((even - 0.25).abs() < 0.02).all()
    distribution = normal(SolverNetwork([NUMBERS], TWO, SETTINGS)(seen)[0])
    drawn = draw_at(distribution, torch.rand(50, 2))
    assert drawn.shape == (50, 2) and 0.4 < drawn.std() < 0.8


def test_of_several_choices_none_is_drawn_that_there_is_not() -> None:
    """Each has as many options as it has; together they are one action."""
    acts = MultiCategorical([2, 5, 3])
    logits, _ = SolverNetwork([NUMBERS], acts, SETTINGS)(torch.rand(4000, 5))
    distribution = joint_categorical(logits)
    drawn = draw_at(distribution, torch.rand(4000, 3))
    assert [set(column.tolist()) for column in drawn.T] == [{0, 1}, set(range(5)), {0, 1, 2}]
    parts = [
        torch.distributions.Categorical(logits=logits[:, i, :n]) for i, n in enumerate((2, 5, 3))
    ]
    torch.testing.assert_close(
        distribution.log_prob(drawn), sum(p.log_prob(drawn[:, i]) for i, p in enumerate(parts))
    )
    torch.testing.assert_close(distribution.entropy(), sum(p.entropy() for p in parts))
    distribution.entropy().sum().backward()


@pytest.mark.parametrize(
    ("shape", "setting", "channels"),
    [
        ((3, 20, 24), None, 3), ((20, 24, 3), None, 3), ((4, 84, 84), None, 4),
        ((7, 7, 20), None, 20), ((84, 84, 1), None, 1), ((9, 9, 9), "CHW", 9),
        ((5, 6, 7), "CHW", 5), ((5, 6, 7), "HWC", 7),
    ],
)  # fmt: skip
def test_images_have_their_channels_where_they_are(shape: Any, setting: Any, channels: int) -> None:
    """Where they are decides what a convolution reads: its numbers are those of the one beside."""
    seen = Unbounded(shape, dtype=torch.uint8)
    settings = NetworkSettings(hidden=[8], channels=[4], image=setting)
    network = SolverNetwork([seen], FOUR, settings)
    first = network.encoder.convolutions[0][0]
    assert first.in_channels == channels
    image = seen.rand()
    moved = image if shape.index(channels) == 0 else image.movedim(-1, 0)
    expected = network.encoder.convolutions[0](moved[None].float() / 255)
    torch.testing.assert_close(network.encoder(image[None]), expected)


def test_an_image_that_does_not_tell_its_channels_is_refused() -> None:
    with pytest.raises(ValueError, match=r"images \[9, 9, 9\].*network.image=HWC or CHW"):
        SolverNetwork([Unbounded((9, 9, 9), dtype=torch.uint8)], FOUR, SETTINGS)


def entries(layout: Layout, seen: Any) -> dict[str, torch.Tensor]:
    return layout.entries(map(torch.as_tensor, in_order(layout.observation_space, seen)))


@pytest.mark.parametrize(
    ("space", "shapes"),
    [
        (spaces.Discrete(5, start=-2), {"observation": (5,)}),
        (spaces.Box(0, 1, (3, 4)), {"observation": (12,)}),
        (spaces.Box(0, 255, (20, 24), np.uint8), {"observation": (20, 24, 1)}),
        (spaces.Box(0, 255, (4, 20, 24, 3), np.uint8), {"observation": (20, 24, 12)}),
        (spaces.Box(0, 255, (4, 3, 20, 24), np.uint8), {"observation": (12, 20, 24)}),
        (Mixed.observation_space, {"observation": (12,), "image camera": (3, 20, 24)}),
    ],
)
def test_what_is_seen_becomes_numbers_and_images(space: Any, shapes: Any) -> None:
    """By Gymnasium's own flattening, and pixel by pixel."""
    layout = Layout(space, spaces.Discrete(2))
    assert {name: tuple(spec.shape) for name, spec in layout.seen.items()} == shapes
    seen = space.sample()
    parts = {name: part.numpy() for name, part in entries(layout, seen).items()}
    for name, part in parts.items():
        assert layout.seen[name].is_in(torch.as_tensor(part))
    if "image camera" in parts:
        rest = spaces.Dict({k: v for k, v in space.items() if k != "camera"})
        flat = spaces.flatten(rest, {k: v for k, v in seen.items() if k != "camera"})
        assert sorted(flat) == pytest.approx(sorted(parts["observation"]))
        assert np.array_equal(parts["image camera"], seen["camera"])
    elif space.dtype != np.uint8:
        assert np.array_equal(parts["observation"], spaces.flatten(space, seen))
    elif seen.ndim == 4 and seen.shape[1] == 3:
        assert np.array_equal(parts["observation"][5], seen[1, 2])
    elif seen.ndim == 4:
        assert np.array_equal(parts["observation"][..., 5], seen[1, ..., 2])
    else:
        assert np.array_equal(parts["observation"][..., 0], seen)


ONE = spaces.Box(-1, 1, (1,))
NAMES = st.sampled_from(["a", "b", "a.b", "a.0", "0", "b.a.b"])
NESTED = st.recursive(
    st.just(ONE),
    lambda inner: (
        st.dictionaries(NAMES, inner, min_size=1, max_size=4).map(spaces.Dict)
        | st.lists(inner, min_size=1, max_size=3).map(tuple).map(spaces.Tuple)
    ),
    max_leaves=8,
)


def reordered(seen: Any) -> Any:
    """As an environment may show it: its dictionaries in another order than the space's."""
    if isinstance(seen, tuple):
        return tuple(map(reordered, seen))
    if isinstance(seen, dict):
        return {name: reordered(part) for name, part in reversed(seen.items())}
    return seen


@profile(max_examples=50, deadline=None)
@given(NESTED)
def test_all_numbers_are_seen_whatever_their_names_are(space: Any) -> None:
    layout, seen = Layout(space, spaces.Discrete(2)), space.sample()
    shown = entries(layout, cast_to(space, reordered(seen)))["observation"].tolist()
    assert sorted(shown) == sorted(spaces.flatten(space, seen))
    assert entries(layout, seen)["observation"].tolist() == shown

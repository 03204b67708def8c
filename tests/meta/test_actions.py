"""What actions mean, against shares and counts worked out by hand."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from proposer_rl.meta.actions import Actions, Mixture, ProblemChoices
from proposer_rl.streams import Streams
from tests.skill_ladder import Kinds


class Numbered(Kinds):
    """Bins along one axis, whose levels are stand-ins: the bin, and a number of the level's own."""

    def generate(self, choices: torch.Tensor, generators: list[torch.Generator]) -> torch.Tensor:
        drawn = [torch.rand(choices.shape[1], generator=g) for g in generators]
        return torch.stack([choices.float(), torch.stack(drawn)], -1)


def generators(count: int, seed: int = 0) -> list[torch.Generator]:
    return [Streams(seed).generator(k) for k in range(count)]


def test_problem_choices_are_the_action() -> None:
    actions = ProblemChoices(Numbered(5))
    action = actions.spec(3, 7, torch.device("cpu")).rand()
    assert action.shape == (3, 7) and action.dtype == torch.int64
    assert torch.equal(actions.draw(action, 7, generators(3)), action)


@given(
    st.lists(st.floats(-3, 3), min_size=2, max_size=6), st.integers(1, 40), st.integers(0, 10**6)
)
def test_a_mixtures_choices_occur_as_often_as_their_shares_say(
    logits: list[float], count: int, seed: int
) -> None:
    action = torch.tensor([logits])
    mixture = Mixture(Numbered(len(logits)), torch.eye(len(logits)))
    counts = mixture.draw(action, count, generators(1, seed))[0].bincount(minlength=len(logits))
    expected = count * action.double().softmax(-1)[0]
    assert counts.sum() == count
    assert ((counts - expected).abs() < 1 + 1e-4).all()


def test_a_mixtures_draws_are_unbiased_and_in_random_order() -> None:
    mixture = Mixture(Numbered(3), torch.tensor([[0.0, 1.0, -0.5]]))
    action = torch.ones(4000, 1)
    drawn = mixture.draw(action, 2, generators(4000))
    shares = torch.tensor([0.0, 1.0, -0.5]).softmax(-1)
    for position in range(2):
        frequency = drawn[:, position].bincount(minlength=3) / 4000
        torch.testing.assert_close(frequency, shares, atol=0.03, rtol=0)


def test_the_zero_action_is_the_even_mixture() -> None:
    mixture = Mixture(Numbered(6), torch.randn(2, 6))
    torch.testing.assert_close(mixture.shares(torch.zeros(1, 2)), torch.full((1, 6), 1 / 6))


def test_a_mixtures_numbers_are_the_axes_of_the_space_unless_others_are_given() -> None:
    mixture = Mixture(Numbered(3))  # at -1, 0 and 1
    expected = torch.tensor([[-2.0, 0.0, 2.0]]).softmax(-1)
    torch.testing.assert_close(mixture.shares(torch.tensor([[2.0]])), expected)


@pytest.mark.parametrize(
    "actions", [ProblemChoices(Numbered(3)), Mixture(Numbered(3), torch.eye(3))]
)
def test_a_copys_levels_depend_on_its_action_and_stream_alone(actions: Actions) -> None:
    action = actions.spec(2, 5, torch.device("cpu")).rand()
    both, choices = actions.levels(action, 5, [Streams(0), Streams(1)])
    alone, own = actions.levels(action[1:], 5, [Streams(1)])
    assert torch.equal(both[1:], alone) and torch.equal(choices[1:], own)
    assert torch.equal(both[..., 0].long(), choices)


def test_levels_are_drawn_apart_from_their_bins() -> None:
    """Of two even bins, what is drawn in one does not tell which one it is."""
    space, streams = Numbered(2), [Streams(seed) for seed in range(400)]
    action = torch.zeros(len(streams), 1)
    drawn, choices = Mixture(space).levels(action, 1, streams)
    named, _ = ProblemChoices(space).levels(choices, 1, streams)
    assert torch.equal(drawn, named)  # however much chance the choices took
    for choice in range(2):
        own = drawn[..., 1][choices == choice]
        assert len(own) > 150
        assert own.mean() == pytest.approx(0.5, abs=0.08)

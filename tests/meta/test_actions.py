"""What actions mean, against shares and counts worked out by hand."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from proposer_rl.meta.actions import Mixture, ProblemChoices, Proposals
from proposer_rl.streams import Streams


def as_levels(choices: torch.Tensor, generators: list[torch.Generator]) -> torch.Tensor:
    """Stand-ins for levels: the choice, and a random number of the level's own."""
    drawn = [torch.rand(choices.shape[1], generator=g) for g in generators]
    return torch.stack([choices.float(), torch.stack(drawn)], -1)


def generators(count: int, seed: int = 0) -> list[torch.Generator]:
    return [Streams(seed).generator(k) for k in range(count)]


def test_problem_choices_are_the_action() -> None:
    proposals = ProblemChoices(5, as_levels)
    action = proposals.action_spec(3, 7, torch.device("cpu")).rand()
    assert action.shape == (3, 7) and action.dtype == torch.int64
    assert torch.equal(proposals.draw(action, 7, generators(3)), action)


@given(
    st.lists(st.floats(-3, 3), min_size=2, max_size=6),
    st.integers(1, 40),
    st.integers(0, 10**6),
)
def test_a_mixtures_choices_occur_as_often_as_their_shares_say(
    logits: list[float], problems: int, seed: int
) -> None:
    action = torch.tensor([logits])
    mixture = Mixture(torch.eye(len(logits)), as_levels)
    counts = mixture.draw(action, problems, generators(1, seed))[0].bincount(minlength=len(logits))
    expected = problems * action.double().softmax(-1)[0]
    assert counts.sum() == problems
    assert ((counts - expected).abs() < 1 + 1e-4).all()


def test_a_mixtures_draws_are_unbiased_and_in_random_order() -> None:
    mixture = Mixture(torch.tensor([[0.0, 1.0, -0.5]]), as_levels)
    action = torch.ones(4000, 1)
    drawn = mixture.draw(action, 2, generators(4000))
    shares = torch.tensor([0.0, 1.0, -0.5]).softmax(-1)
    for position in range(2):
        frequency = drawn[:, position].bincount(minlength=3) / 4000
        torch.testing.assert_close(frequency, shares, atol=0.03, rtol=0)


def test_the_zero_action_is_the_even_mixture() -> None:
    mixture = Mixture(torch.randn(2, 6), as_levels)
    torch.testing.assert_close(mixture.shares(torch.zeros(1, 2)), torch.full((1, 6), 1 / 6))


@pytest.mark.parametrize(
    "proposals", [ProblemChoices(3, as_levels), Mixture(torch.eye(3), as_levels)]
)
def test_a_copys_levels_depend_on_its_action_and_stream_alone(proposals: Proposals) -> None:
    action = proposals.action_spec(2, 5, torch.device("cpu")).rand()
    both, choices = proposals.levels(action, 5, [Streams(0), Streams(1)])
    alone, own = proposals.levels(action[1:], 5, [Streams(1)])
    assert torch.equal(both[1:], alone) and torch.equal(choices[1:], own)
    assert torch.equal(both[..., 0].long(), choices)


def test_refuses_what_is_no_set_of_choices() -> None:
    with pytest.raises(ValueError, match="choices must be at least 1, got 0"):
        ProblemChoices(0, as_levels)
    for directions in (torch.zeros(3), torch.full((1, 2), torch.inf), torch.zeros(0, 2)):
        with pytest.raises(ValueError, match="finite matrix"):
            Mixture(directions, as_levels)

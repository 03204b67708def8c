from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from proposer_rl.models import ProposerNetwork, fourier_encoding, proposer_actor_critic


def network(**options) -> ProposerNetwork:
    torch.manual_seed(0)
    return ProposerNetwork(7, problems=6, choices=5, context=16, hidden=16, **options)


def test_shapes() -> None:
    logits, value = network()(torch.rand(2, 3, 4, 7, 10, 10))
    assert logits.shape == (2, 3, 6, 5)
    assert value.shape == (2, 3, 1)


def test_the_probes_are_a_set() -> None:
    probes = torch.rand(2, 4, 7, 10, 10)
    for one, other in zip(network()(probes), network()(probes.flip(1)), strict=True):
        torch.testing.assert_close(one, other)


def test_without_probes_every_state_looks_alike() -> None:
    logits, value = network()(torch.rand(3, 0, 7, 10, 10))
    assert logits.shape == (3, 6, 5)
    assert torch.equal(logits[0], logits[2]) and torch.equal(value[0], value[2])


def test_the_first_policy_is_nearly_uniform_but_not_the_same_for_all_problems() -> None:
    logits, _ = network()(torch.rand(1, 4, 7, 10, 10))
    assert (logits.softmax(-1) - 1 / 5).abs().max() < 0.02
    assert logits.std(-2).max() > 0


@pytest.mark.parametrize("problems", [1, 2, 16, 128])
def test_problem_encodings_are_distinct(problems: int) -> None:
    encoding = fourier_encoding(problems, 16)
    assert encoding.shape == (problems, 32)
    distances = torch.cdist(encoding, encoding) + 10 * torch.eye(problems)
    assert distances.min() > 0.1


def test_ratios_differ_in_what_is_one_event() -> None:
    probes = TensorDict({"probes": torch.rand(2, 4, 7, 10, 10)}, [2])
    events = {}
    for ratio in ("joint", "per_problem"):
        agent = proposer_actor_critic(network(), ratio)
        distribution = agent.distribution(agent(probes.clone()))
        events[ratio] = distribution.log_prob(torch.ones(2, 6, dtype=torch.int64))
    assert events["joint"].shape == (2,) and events["per_problem"].shape == (2, 6)
    torch.testing.assert_close(events["joint"], events["per_problem"].sum(-1))


def test_refuses_an_unknown_ratio() -> None:
    with pytest.raises(ValueError, match=r"one of \['joint', 'per_problem'\], got 'each'"):
        proposer_actor_critic(network(), "each")

from __future__ import annotations

import torch
from scipy import stats
from tensordict import TensorDict
from torch import nn

from proposer_rl import models


def maps(features: int) -> models.MapEncoder:
    return models.MapEncoder(7, (32, 64), features)


def network(**options) -> models.ProposerNetwork:
    torch.manual_seed(0)
    numbers = options.get("numbers", 0)
    head = models.ProblemHead(16 + numbers, problems=6, choices=5, hidden=16)
    return models.ProposerNetwork(head, maps(16), context=16, hidden=16, **options)


def test_probes_may_be_vectors() -> None:
    """What an encoder makes of each, averaged and cut off at zero, is the context."""
    torch.manual_seed(0)
    encoder = nn.Linear(3, 4)
    network = models.ProposerNetwork(nn.Identity(), encoder, context=4, hidden=8)
    probes = torch.rand(2, 5, 3)
    context, _ = network(probes)
    expected = torch.stack([encoder(probe).mean(0).clamp(min=0) for probe in probes])
    torch.testing.assert_close(context, expected)


def test_an_encoder_of_maps_reads_each_by_itself() -> None:
    torch.manual_seed(0)
    encoder, probes = maps(5), torch.rand(2, 3, 7, 6, 4)
    features = encoder(probes)
    assert features.shape == (2, 3, 5)
    torch.testing.assert_close(features[1, 2], encoder(probes[1:, 2:])[0, 0])


def test_without_probes_every_state_looks_alike() -> None:
    logits, value = network()(torch.rand(3, 0, 7, 10, 10))
    assert logits.shape == (3, 6, 5)
    assert torch.equal(logits[0], logits[2]) and torch.equal(value[0], value[2])


def test_the_first_policy_is_nearly_uniform_but_not_the_same_for_all_problems() -> None:
    logits, _ = network()(torch.rand(1, 4, 7, 10, 10))
    assert (logits.softmax(-1) - 1 / 5).abs().max() < 0.02
    assert logits.std(-2).max() > 0


def test_ratios_differ_in_what_is_one_event() -> None:
    probes = TensorDict({"probes": torch.rand(2, 4, 7, 10, 10)}, [2])
    events = {}
    for ratio in (models.joint_categorical, models.categorical):
        agent = models.proposer_actor_critic(network(), ratio)
        distribution = agent.distribution(agent(probes.clone()))
        events[ratio] = distribution.log_prob(torch.ones(2, 6, dtype=torch.int64))
    assert events[models.joint_categorical].shape == (2,) and events[models.categorical].shape == (
        2,
        6,
    )
    torch.testing.assert_close(events[models.joint_categorical], events[models.categorical].sum(-1))


def test_numbers_beside_the_probes_reach_policy_and_value() -> None:
    agent = models.proposer_actor_critic(
        network(numbers=2), models.categorical, ["probes", "gain", "time"]
    )
    seen = TensorDict({"probes": torch.rand(1, 4, 7, 10, 10)}, [1]).expand(2).clone()
    seen["gain"], seen["time"] = torch.tensor([[0.0], [1.0]]), torch.zeros(2, 1)
    out = agent(seen)
    for entry in ("logits", "state_value"):
        assert not torch.allclose(out[entry][0], out[entry][1])


def test_the_first_mixture_policy_is_centred_on_the_even_mixture() -> None:
    torch.manual_seed(0)
    head = models.MixtureHead(16, directions=3, hidden=32, spread=1.5)
    distribution = models.normal(head(torch.randn(100, 16)))
    assert distribution.mean.abs().max() < 0.1
    torch.testing.assert_close(distribution.stddev, torch.full((100, 3), 1.5))


def test_normal_is_that_of_scipy_and_drawn_by_its_quantiles() -> None:
    parameters = torch.tensor([[0.5, 0.3], [-2.0, -1.0]])  # location, log-scale
    distribution, point = models.normal(parameters), torch.tensor([0.1, -1.7])
    reference = stats.norm(parameters[:, 0].numpy(), parameters[:, 1].exp().numpy())
    torch.testing.assert_close(
        float(distribution.log_prob(point)), float(reference.logpdf(point.numpy()).sum()),
        rtol=1e-5, atol=1e-6,
    )  # fmt: skip
    uniform = torch.tensor([0.0, 0.9])
    drawn = models.draw_at(distribution, uniform)
    assert drawn.isfinite().all()
    torch.testing.assert_close(float(drawn[1]), float(reference.ppf(0.9)[1]), rtol=1e-5, atol=1e-6)

"""First-order gain and lengths of gradients against derivatives that are taken in other ways."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from itertools import product

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.nn.functional import unfold

from proposer_rl.learning import PPO, DivergedError, PPOSettings
from proposer_rl.meta import first_order
from proposer_rl.meta import first_order as fo
from proposer_rl.models import ActorCritic, Population, UNet, categorical
from proposer_rl.models.grids import cell_logits, read_maps
from proposer_rl.streams import Streams
from proposer_rl.tasks.mazes import Level, MazeEnv, generate_levels, planes
from proposer_rl.tasks.mazes.evaluation import ExactEvaluator
from tests.tiny import TASK

EVALUATE = ExactEvaluator(max_steps=8)
RATE = 1e-3


class Small(nn.Module):
    """K policies of what is next to a cell, in double precision; values are zero."""

    def __init__(self, copies: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        weight = torch.randn(copies, 4, 27, generator=generator, dtype=torch.float64)
        self.weight = nn.Parameter(0.5 * weight)
        self.bias = nn.Parameter(torch.zeros(copies, 4, 1, dtype=torch.float64))

    def forward(self, planes: Tensor) -> tuple[Tensor, Tensor]:
        neighbours = unfold(planes.flatten(0, 1).double(), 3, padding=1)  # [K * P, 27, H * W]
        logits = self.weight.unsqueeze(1) @ neighbours.unflatten(0, planes.shape[:2])
        logits = (logits + self.bias.unsqueeze(1)).unflatten(-1, planes.shape[-2:])
        return logits, torch.zeros_like(logits[..., :1, :, :])


def learner(levels: Level, copies: int = 2, network: nn.Module | None = None) -> PPO:
    """Solvers in the environment of levels [K, P], whose Adam has made a step or two."""
    network = Small(copies) if network is None else network
    maps = TensorDictModule(network, ["planes"], ["policy_map", "value_map"])
    keys = ["policy_map", "value_map", "agent"]
    head = TensorDictModule(read_maps, keys, ["logits", "state_value"])
    agent = ActorCritic(head, maps, distribution_class=categorical, copies=copies)
    settings = PPOSettings(
        horizon=8, epochs=1, learning_rate=RATE, gamma=1.0, lmbda=1.0, normalize_advantage=False
    )
    ppo = PPO(MazeEnv(levels, max_steps=8), agent, settings)
    snapshot, generator = ppo.snapshot(), torch.Generator().manual_seed(1)
    for name in snapshot.keys():
        square = snapshot[name, "exp_avg_sq"]
        square.copy_(1e-4 * torch.rand(square.shape, generator=generator, dtype=torch.float64))
        snapshot[name, "step"].fill_(3)
    ppo.restore(snapshot)
    return ppo


def some_levels(copies: int, count: int) -> Level:
    generator = torch.Generator().manual_seed(0)
    fraction = torch.full((copies, count), 0.2)
    return generate_levels(fraction, 3, 4, 4, generator=generator)


def performance(agent: ActorCritic, levels: Level) -> TensorDict:
    logits = cell_logits(agent, planes(levels), gradients=torch.is_grad_enabled())
    return EVALUATE(levels, logits)


def exact_direction(ppo: PPO, levels: Level, measure: str = "log_success") -> dict[str, Tensor]:
    return fo.target_direction(ppo, fo.target_performance(performance(ppo.agent, levels), measure))


def aligned(ppo: PPO, direction: dict[str, Tensor], levels: Level, step: float = RATE) -> Tensor:
    """The slope of the exact return of levels [K, E] along a direction, by differences."""
    return fo.alignment(
        ppo.agent, direction, step, lambda: performance(ppo.agent, levels)["return"]
    )


def inner(one: dict[str, Tensor], other: dict[str, Tensor]) -> Tensor:
    return torch.stack([(one[name] * other[name]).flatten(1).sum(1) for name in one]).sum(0)


def central_differences(
    agent: ActorCritic, value: Callable[[], Tensor]
) -> Iterator[tuple[str, int, Tensor]]:
    """Slopes of values [K, ...] along the i-th number of each parameter, of all Solvers at once."""
    for name, parameter in agent.named_parameters():
        for i in range(parameter[0].numel()):
            values = []
            for change in (1e-6, -1e-6):
                one = {n: torch.zeros_like(p) for n, p in agent.named_parameters()}
                one[name].flatten(1)[:, i] = change
                with torch.no_grad(), fo.moved_along(agent, one, 1.0):
                    values.append(value())
            yield name, i, (values[0] - values[1]) / 2e-6


def gradient(agent: ActorCritic, value: Tensor) -> dict[str, Tensor]:
    names, parameters = zip(*agent.named_parameters(), strict=True)
    found = torch.autograd.grad(value, parameters, materialize_grads=True)
    return dict(zip(names, found, strict=True))


@pytest.mark.parametrize("measure", ["log_success", "return"])
def test_the_direction_is_the_preconditioned_slope_of_the_targets_performance(measure: str) -> None:
    levels = some_levels(2, 5)
    ppo = learner(levels)
    found = exact_direction(ppo, levels, measure)

    def value() -> Tensor:
        result = EVALUATE(levels, cell_logits(ppo.agent, planes(levels)))
        worth = result["return"] if measure == "return" else (result["success"] + 1e-3).log()
        return worth.mean(1)

    slopes = {name: torch.zeros_like(p) for name, p in ppo.agent.named_parameters()}
    for name, i, slope in central_differences(ppo.agent, value):
        slopes[name].flatten(1)[:, i] = slope
    expected = {}
    for name, slope in slopes.items():
        second = ppo.snapshot()[name, "exp_avg_sq"] / (1 - 0.999**3)
        expected[name] = slope / (second.sqrt() + 1e-5)
    for k in range(2):
        flat = torch.cat([x[k].flatten() for x in expected.values()])
        scale = flat.square().mean().sqrt()
        for name, entry in found.items():
            torch.testing.assert_close(entry[k], expected[name][k] / scale, rtol=1e-5, atol=1e-7)


def test_the_direction_leaves_frozen_parameters_out() -> None:
    levels = some_levels(2, 5)
    ppo = learner(levels)
    (weight, bias), whole = ppo.agent.named_parameters(), exact_direction(ppo, levels)
    bias[1].requires_grad_(False)
    found = exact_direction(ppo, levels)
    assert [*found] == [weight[0]]
    turned = nn.functional.cosine_similarity(*(x[weight[0]].flatten(1) for x in (found, whole)))
    torch.testing.assert_close(turned, torch.ones_like(turned))
    slope = aligned(ppo, found, levels)
    still = {**found, bias[0]: torch.zeros_like(bias[1])}
    bias[1].requires_grad_(True)
    assert slope.equal(aligned(ppo, still, levels))


def test_before_the_first_step_it_is_the_gradients_direction() -> None:
    levels = some_levels(2, 5)
    ppo = learner(levels)
    fresh = ppo.snapshot()
    for name in fresh.keys():
        fresh[name, "exp_avg_sq"].zero_()
        fresh[name, "step"].zero_()
    ppo.restore(fresh)
    found = exact_direction(ppo, levels, "return")
    value = performance(ppo.agent, levels)["return"].mean(1).sum()
    slope = gradient(ppo.agent, value)
    torch.testing.assert_close(fo.root_mean_square(found), torch.ones(2, dtype=torch.float64))
    cosine = inner(found, slope) / (inner(found, found) * inner(slope, slope)).sqrt()
    torch.testing.assert_close(cosine, torch.ones(2, dtype=torch.float64))


def test_an_alignment_tells_what_a_small_step_changes() -> None:
    target, levels = some_levels(2, 5), some_levels(2, 7)
    ppo = learner(target)
    direction = exact_direction(ppo, target)

    def returns() -> Tensor:
        return performance(ppo.agent, levels)["return"]

    slope = fo.alignment(ppo.agent, direction, RATE, returns)
    before = returns().detach()
    remainder = []
    for step in (1e-3, 1e-4):
        with torch.no_grad(), fo.moved_along(ppo.agent, direction, step):
            remainder.append((returns() - before - step * slope).abs().max())
    assert remainder[0] < 0.01 * (1e-3 * slope).abs().max()
    # Of second order: a tenth of the step leaves a hundredth of it.
    assert remainder[1] < 0.02 * remainder[0]


@pytest.mark.parametrize("double", [True, False])
def test_an_alignment_is_the_inner_product_with_the_levels_gradient(double: bool) -> None:
    target, levels = some_levels(2, 5), some_levels(2, 4)
    torch.manual_seed(0)
    network = None if double else Population(lambda: UNet(channels=(8, 8)), copies=2, cores=1)
    ppo = learner(target, network=network)
    direction, step = exact_direction(ppo, target), RATE if double else 1e-5
    found = aligned(ppo, direction, levels, step)
    for p in range(4):
        returns = performance(ppo.agent, levels)["return"][:, p]
        expected = inner(direction, gradient(ppo.agent, returns.sum()))
        # In single precision the difference of two returns is rounded at about 1e-7 / step; a
        # network with kinks, as this one has them, needs a step as short as that.
        torch.testing.assert_close(
            found[:, p], expected, rtol=1e-4 if double else 0.02, atol=1e-9 if double else 1e-2
        )


@pytest.mark.parametrize("fails", [False, True])
def test_moved_weights_come_back_bit_by_bit(fails: bool) -> None:
    ppo = learner(some_levels(2, 3), network=Population(lambda: UNet(channels=(8, 8)), 2, cores=1))
    before = {name: p.detach().clone() for name, p in ppo.agent.named_parameters()}
    places = {name: p.data_ptr() for name, p in ppo.agent.named_parameters()}
    direction = {name: torch.randn_like(p) for name, p in before.items()}

    def worth() -> Tensor:
        for name, parameter in ppo.agent.named_parameters():
            assert not torch.equal(parameter, before[name])
        if fails:
            raise KeyError("no such level")
        return torch.zeros(2, 1)

    with pytest.raises(KeyError) if fails else nullcontext():
        fo.alignment(ppo.agent, direction, 0.1, worth)
    for name, parameter in ppo.agent.named_parameters():
        assert parameter.data_ptr() == places[name]  # still what Adam moves
        assert torch.equal(parameter.view(torch.int32), before[name].view(torch.int32))


@pytest.mark.parametrize(
    ("factor", "message"), [(0.0, "copy 1: .* is zero"), (float("nan"), "copy 1: .* is not finite")]
)
def test_a_direction_that_is_none_is_an_error(factor: float, message: str) -> None:
    levels = some_levels(2, 3)
    ppo = learner(levels)
    returns = performance(ppo.agent, levels)["return"].mean(1)
    with pytest.raises(DivergedError, match=message):
        fo.target_direction(ppo, returns * torch.tensor([1.0, factor]))


def test_a_target_without_any_success_is_told_in_one_line() -> None:
    success = torch.tensor([[0.0, 1e-30], [0.0, 0.0]])
    told = "copy 1: the probability of success is exactly 0 on each of 2 levels"
    with pytest.raises(DivergedError, match=told) as info:
        fo.target_performance(TensorDict({"success": success}, [2, 2]), "log_success")
    assert "\n" not in str(info.value)


def test_scores_are_means_with_standard_errors() -> None:
    values = torch.randn(2, 3, 16, generator=torch.Generator().manual_seed(0))
    score, error = fo.bin_scores(values)
    np.testing.assert_allclose(score, values.numpy().mean(-1), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(error, values.numpy().std(-1, ddof=1) / 4, rtol=1e-5)
    assert fo.bin_scores(values[..., :1])[1].isinf().all()


class Precise:
    """Policies of a few numbers in double precision, as much of a task as is asked of one here."""

    device = torch.device("cpu")

    def learner(self, streams: Sequence[Streams]) -> PPO:
        return learner(some_levels(len(streams), 1), len(streams))

    def differentiable_performance(self, agent: ActorCritic, levels: Level) -> TensorDictBase:
        return performance(agent, levels)


def numerical(ppo: PPO, levels: Level) -> Tensor:
    """Sums of squared central differences over every single parameter: float [K, n]."""
    total = torch.zeros(levels.batch_size, dtype=torch.float64)
    for *_, slope in central_differences(
        ppo.agent, lambda: performance(ppo.agent, levels)["return"]
    ):
        total += slope.square()
    return total


def one_by_one(ppo: PPO, value: Callable[[], Tensor]) -> Tensor:
    """|grad|^2 of each of the values [K, n], by a backward pass of its own and nothing else."""
    found = torch.zeros(value().shape, dtype=value().dtype)
    for k, i in product(*map(range, found.shape)):
        ppo.agent.zero_grad()
        value()[k, i].backward()
        found[k, i] = sum(
            p.grad.square().sum() for p in ppo.agent.parameters() if p.grad is not None
        )
    return found


@pytest.mark.parametrize("at_once", [1, 3, 8])
def test_they_are_those_of_finite_differences(
    at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(first_order, "LEVELS_AT_ONCE", at_once)
    ppo, levels = learner(some_levels(2, 1)), some_levels(2, 4)
    found = fo.LevelGradients(Precise()).of_returns(ppo, levels)
    torch.testing.assert_close(found, numerical(ppo, levels), rtol=1e-6, atol=1e-12)
    assert not found.requires_grad and (found[0] != found[1]).all()


def test_they_are_those_of_single_levels_also_after_training() -> None:
    ppo = TASK.learner([Streams(0), Streams(1)])
    score = fo.LevelGradients(TASK).of_returns
    levels = torch.stack([TASK.space.sample(5, Streams(k).generator()) for k in (0, 1)])
    for _ in range(2):  # the same population serves Solvers that have changed
        before = ppo.snapshot()
        found = score(ppo, levels)
        assert (ppo.snapshot() == before).all()
        expected = one_by_one(
            ppo, lambda: TASK.differentiable_performance(ppo.agent, levels)["return"]
        )
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-9)
        ppo.update([Streams(k).generator("actions") for k in (0, 1)])


def test_those_of_episodes_are_of_single_policy_gradients() -> None:
    ppo = TASK.learner([Streams(0), Streams(1)])
    ppo.update([Streams(k).generator("first") for k in (0, 1)])  # a fresh policy is nearly even
    rollout = ppo.collect([Streams(k).generator("actions") for k in (0, 1)])
    advantage = torch.randn(rollout.shape, generator=torch.Generator().manual_seed(0))
    found = fo.LevelGradients(TASK).of_rollouts(ppo, rollout, advantage)

    def gained() -> Tensor:
        steps = ppo.agent(rollout.exclude("next").clone())["logits"].log_softmax(-1)
        taken = steps.gather(-1, rollout["action"].unsqueeze(-1)).squeeze(-1)
        return (taken * advantage).mean(-1)

    torch.testing.assert_close(found, one_by_one(ppo, gained), rtol=1e-3, atol=1e-9)


def test_where_the_return_cannot_change_it_is_zero() -> None:
    solvable, walled = "S..\n...\n..G", "S#.\n##.\n..G"
    levels = Level.from_text([walled, solvable, walled]).reshape(1, 3)
    found = fo.LevelGradients(Precise()).of_returns(learner(levels, 1), levels)
    assert found[0, 0] == found[0, 2] == 0 < found[0, 1]


def test_the_uniform_policy_next_to_the_goal_in_closed_form() -> None:
    """With p = 1/4 to go right, J = 1 - (1 - p)^8 - 0.01 * sum over t < 8 of (1 - p)^t.

    The slope towards the logit of action a is dJ/dp p (1[a = right] - p). A logit has a bias and
    two weights whose inputs are 1: of the start here, and of the goal to the right.
    """
    levels = Level.from_text("SG").reshape(1, 1)
    ppo = learner(levels, 1)
    for parameter in ppo.agent.parameters():
        parameter.data.zero_()
    slope = 8 * 0.75**7 + 0.01 * sum(t * 0.75 ** (t - 1) for t in range(8))
    expected = 3 * slope**2 * sum((0.25 * ((a == 3) - 0.25)) ** 2 for a in range(4))
    found = fo.LevelGradients(Precise()).of_returns(ppo, levels)
    assert found.item() == pytest.approx(expected, rel=1e-12)


def test_frozen_parameters_add_nothing() -> None:
    class Frozen(Precise):
        """The same without their biases' training."""

        def learner(self, streams: Sequence[Streams]) -> PPO:
            ppo = super().learner(streams)
            [*ppo.agent.parameters()][1].requires_grad_(False)
            return ppo

    levels = some_levels(2, 3)
    found = fo.LevelGradients(Frozen()).of_returns(
        ppo := Frozen().learner([Streams(0)] * 2), levels
    )
    expected = one_by_one(ppo, lambda: performance(ppo.agent, levels)["return"])
    torch.testing.assert_close(found, expected)
    assert (found < fo.LevelGradients(Precise()).of_returns(ppo, levels)).all()

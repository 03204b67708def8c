"""The curriculum in closed form: on Solvers whose best batch is known, and on mazes."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from proposer_rl.curricula import (
    FirstOrderCurriculum,
    TaskStudent,
)
from proposer_rl.learning import PPO
from proposer_rl.streams import Streams
from proposer_rl.task import Task
from proposer_rl.tasks.mazes import Level, SpecificationSpace
from proposer_rl.tasks.mazes.distributions import LevelDistribution
from tests.meta import test_first_order as exact

BINS, P = 6, 16


class Skills:
    """K Solvers that are numbers: the return of bin n is skill n, of the target a sum of some."""

    def __init__(self, copies: int, wanted: list[float]) -> None:
        self.wanted = torch.tensor(wanted)
        module = nn.Module()
        module.skills = nn.Parameter(torch.zeros(copies, len(wanted)))
        self.agent = module
        self.settings = SimpleNamespace(learning_rate=0.01, adam_eps=0.0, gamma=1.0, lmbda=1.0)
        self.env = SimpleNamespace(batch_size=torch.Size([copies, P]))
        self.device, self.batch_size, self.distributions = torch.device("cpu"), P, {}
        self.target = SimpleNamespace(sample=lambda count, generator: torch.full((count,), -1))
        self.space = SimpleNamespace(
            size=len(wanted),
            axes={"row": [0.0, 1.0], "column": [0.0, 1.0, 2.0]},
            generate=lambda choices, generators: choices,
        )

    def snapshot(self) -> TensorDict:
        """Adam's state before its first step."""
        skills = self.agent.skills.detach()
        zero = torch.zeros(len(skills))
        return TensorDict({"skills": {"exp_avg_sq": 0 * skills, "step": zero}}, [len(skills)])

    def differentiable_performance(self, agent: nn.Module, levels: Tensor) -> TensorDict:
        of_bins = agent.skills.gather(1, levels.clamp(min=0))
        target = (agent.skills @ self.wanted).unsqueeze(1)
        return TensorDict({"return": torch.where(levels < 0, target, of_bins)}, levels.shape)


def taught(task: Any, learner: Any = None) -> TaskStudent:
    return TaskStudent(task, learner or task)


def test_shares_follow_the_known_alignments() -> None:
    wanted = [2.0, 1.0, 0.0, -1.0, 0.0, 0.5]
    task = Skills(3, wanted)
    curriculum = FirstOrderCurriculum(task.space, task.target, measure="return", temperature=0.5)
    levels = curriculum.propose(taught(task), P, [Streams(seed) for seed in range(3)]).levels
    # The direction is that of the wanted skills, and the alignment of bin n its n-th number.
    expected = (torch.tensor(wanted) / (0.5 * 2.0)).softmax(-1)
    torch.testing.assert_close(curriculum.shares(), expected.expand(3, -1), rtol=1e-4, atol=1e-6)
    counts = nn.functional.one_hot(levels, BINS).sum(1)
    assert ((counts - P * expected).abs() < 1).all()
    assert not torch.equal(levels[0], levels[1])  # each has its own random order


def test_scores_are_averaged_over_time() -> None:
    task = Skills(1, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    curriculum = FirstOrderCurriculum(
        task.space, task.target, measure="return", every=1, smoothing=0.75
    )
    curriculum.propose(taught(task), P, [Streams(0)])
    first = curriculum.state_dict()["scores"]["score"]
    task.wanted = torch.tensor([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    curriculum.propose(taught(task), P, [Streams(0)])
    second = curriculum.state_dict()["scores"]["score"]
    torch.testing.assert_close(second[0, :2] / first[0, 0], torch.tensor([0.75, 0.25]))


def test_bins_without_any_score_are_drawn_uniformly() -> None:
    task = Skills(1, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    curriculum = FirstOrderCurriculum(task.space, task.target, measure="return")
    curriculum.scores = {"score": torch.zeros(1, BINS), "variance": torch.zeros(1, BINS)}
    torch.testing.assert_close(curriculum.shares(), torch.full((1, BINS), 1 / BINS))


class Axes(SpecificationSpace):
    axes = {"obstacle fraction": [0.0, 0.2, 0.3], "path length": [2.0, 4.0]}  # noqa: RUF012


class Mazes(Skills):
    """Small mazes with the exact evaluation of what plays them."""

    spectators = Task.spectators

    def __init__(self) -> None:
        self.device, self.batch_size, self.distributions = torch.device("cpu"), P, {}
        self.target = LevelDistribution([(0.3, 4)], "uniform", 4, 4)
        self.space = Axes((0.0, 0.2, 0.3), (2, 4), "uniform", 4, 4)

    def differentiable_performance(self, agent: nn.Module, levels: Level) -> TensorDict:
        return exact.performance(agent, levels)

    def performance(self, agent: nn.Module, levels: Level, generator: Any) -> TensorDict:
        return exact.performance(agent, levels)


def mazes(**options: Any) -> FirstOrderCurriculum:
    task = Mazes()
    return FirstOrderCurriculum(
        task.space, task.target, **{"target_levels": 8, "candidates": 3, **options}
    )


def learner(copies: int = 2) -> PPO:
    return exact.learner(exact.some_levels(copies, P), copies)


def streams(update: int, *seeds: int) -> list[Streams]:
    return [Streams(seed, "update", update) for seed in seeds]


def test_scores_are_mean_inner_products_with_the_target_direction() -> None:
    task, solvers, curriculum = Mazes(), learner(), mazes()
    curriculum.propose(taught(Mazes(), solvers), P, streams(0, 0, 1))
    found = curriculum.state_dict()["scores"]
    own = streams(0, 0, 1)
    target = torch.stack([task.target.sample(8, s.generator("target")) for s in own])
    direction = exact.exact_direction(solvers, target)
    bins = torch.arange(BINS).repeat_interleave(3).expand(2, -1)
    levels = task.space.generate(bins, [s.generator("candidates") for s in own])
    each = torch.stack(
        [
            exact.inner(direction, exact.gradient(solvers.agent, value.sum()))
            for value in (
                exact.performance(solvers.agent, levels)["return"][:, i] for i in range(3 * BINS)
            )
        ],
        1,
    ).unflatten(1, (BINS, 3))
    torch.testing.assert_close(found["score"], each.mean(-1), rtol=1e-4, atol=1e-7)
    torch.testing.assert_close(found["variance"], each.var(-1) / 3, rtol=1e-3, atol=1e-10)
    far = mazes(step=1000.0)  # differences, and no derivatives any more
    far.propose(taught(Mazes(), solvers), P, streams(0, 0, 1))
    assert not torch.allclose(far.state_dict()["scores"]["score"], each.mean(-1), rtol=0.05)


def test_the_log_has_standard_errors_and_how_even_the_shares_are() -> None:
    curriculum, solvers = mazes(), learner()
    curriculum.propose(taught(Mazes(), solvers), P, streams(0, 0, 1))
    told = json.loads(json.dumps(curriculum.log()))
    assert torch.tensor(told["score"]).shape == torch.tensor(told["score_error"]).shape == (2, 3, 2)
    shares = curriculum.shares()
    torch.testing.assert_close(
        torch.tensor(told["share_entropy"]).double(),
        torch.distributions.Categorical(shares).entropy(),
    )
    assert all(1 <= bins <= BINS for bins in told["effective_bins"])

"""The curriculum in closed form: on Solvers whose best batch is known, and on mazes."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from proposer_rl import curricula as c
from proposer_rl.learning import PPO
from proposer_rl.streams import Streams
from proposer_rl.task import Task
from proposer_rl.tasks.mazes import Level, SpecificationSpace
from proposer_rl.tasks.mazes.generation import LevelDistribution
from tests.meta import test_first_order as exact

BINS, P = 6, 16


class Skills:
    """A Solver that is numbers: the return of bin n is skill n, of the target a sum of some."""

    copies = 1

    def __init__(self, wanted: list[float]) -> None:
        self.wanted = torch.tensor(wanted)
        module = nn.Module()
        module.skills = nn.Parameter(torch.zeros(1, len(wanted)))
        self.agent = module
        self.settings = SimpleNamespace(learning_rate=0.01, adam_eps=0.0, gamma=1.0, lmbda=1.0)
        self.env = SimpleNamespace(batch_size=torch.Size([1, P]))
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


def taught(task: Any, learner: Any = None) -> c.TaskStudent:
    return c.TaskStudent(task, learner or task)


def test_shares_follow_the_known_alignments() -> None:
    wanted = [2.0, 1.0, 0.0, -1.0, 0.0, 0.5]
    task = Skills(wanted)
    curriculum = c.FirstOrderCurriculum(task.space, task.target, measure="return", temperature=0.5)
    levels = curriculum.propose(taught(task), P, Streams(0)).levels
    # The direction is that of the wanted skills, and the alignment of bin n its n-th number.
    expected = (torch.tensor(wanted) / (0.5 * 2.0)).softmax(-1)
    torch.testing.assert_close(curriculum.shares(), expected, rtol=1e-4, atol=1e-6)
    assert ((levels.bincount(minlength=BINS) - P * expected).abs() < 1).all()


def test_scores_are_averaged_over_time() -> None:
    task = Skills([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    curriculum = c.FirstOrderCurriculum(
        task.space, task.target, measure="return", every=1, smoothing=0.75
    )
    curriculum.propose(taught(task), P, Streams(0))
    first = curriculum.state_dict()["scores"]["score"]
    task.wanted = torch.tensor([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    curriculum.propose(taught(task), P, Streams(0))
    second = curriculum.state_dict()["scores"]["score"]
    torch.testing.assert_close(second[:2] / first[0], torch.tensor([0.75, 0.25]))


def test_bins_without_any_score_are_drawn_uniformly() -> None:
    task = Skills([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    curriculum = c.FirstOrderCurriculum(task.space, task.target, measure="return")
    curriculum.scores = {"score": torch.zeros(BINS), "variance": torch.zeros(BINS)}
    torch.testing.assert_close(curriculum.shares(), torch.full((BINS,), 1 / BINS))


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


def mazes(**options: Any) -> c.FirstOrderCurriculum:
    task = Mazes()
    return c.FirstOrderCurriculum(
        task.space, task.target, **{"target_levels": 8, "candidates": 3, **options}
    )


def learner() -> PPO:
    return exact.learner(exact.some_levels(1, P), 1)


def test_scores_are_mean_inner_products_with_the_target_direction() -> None:
    task, solver, curriculum = Mazes(), learner(), mazes(step=0.3)  # nearly a derivative
    curriculum.propose(taught(Mazes(), solver), P, Streams(0))
    found = curriculum.state_dict()["scores"]
    target = task.target.sample(8, Streams(0).generator("target"))[None]
    direction = exact.exact_direction(solver, target)
    bins = torch.arange(BINS).repeat_interleave(3)[None]
    levels = task.space.generate(bins, [Streams(0).generator("candidates")])
    values = (exact.performance(solver.agent, levels)["return"][:, i] for i in range(3 * BINS))
    aligned = [exact.inner(direction, exact.gradient(solver.agent, one.sum())) for one in values]
    each = torch.stack(aligned, 1).unflatten(1, (BINS, 3))[0]
    torch.testing.assert_close(found["score"], each.mean(-1), rtol=1e-4, atol=1e-7)
    torch.testing.assert_close(found["variance"], each.var(-1) / 3, rtol=1e-3, atol=1e-10)
    far = mazes(step=1000.0)  # differences, and no derivatives any more
    far.propose(taught(Mazes(), solver), P, Streams(0))
    assert not torch.allclose(far.state_dict()["scores"]["score"], each.mean(-1), rtol=0.05)


def test_the_log_has_standard_errors_and_how_even_the_shares_are() -> None:
    curriculum, solver = mazes(), learner()
    curriculum.propose(taught(Mazes(), solver), P, Streams(0))
    told = json.loads(json.dumps(curriculum.log()))
    assert torch.tensor(told["score"]).shape == torch.tensor(told["score_error"]).shape == (3, 2)
    entropy = torch.distributions.Categorical(curriculum.shares()).entropy()
    assert told["share_entropy"] == pytest.approx(float(entropy))
    assert 1 <= told["effective_bins"] <= BINS

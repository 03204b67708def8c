"""Exact scores of the law of an episode: a table, drawn maxima, and ever more real episodes."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from proposer_rl.curricula import Student, TaskStudent
from proposer_rl.curricula.exact_scores import expected_best, return_variance
from proposer_rl.curricula.scores import AT_ONCE, Scored, Scorer, unseen
from proposer_rl.learning import PPOSettings, SolverSettings
from proposer_rl.streams import Streams
from proposer_rl.task import EpisodeLaw, NoSuccessError
from proposer_rl.tasks.mazes import Level
from proposer_rl.tasks.mazes.evaluation import episode_law, optimal_return
from tests.curricula.scripted import Scripted
from tests.tiny import tiny_task

UNIFORM, NO_VALUES = torch.full((4, 1, 2), 0.25), torch.zeros(1, 2)
TABLE = episode_law(Level.from_text("SG"), UNIFORM, NO_VALUES, max_steps=2)
COPIES, EPISODES = 1024, 4


def of_returns(outcome: list[float], probability: list[float]) -> EpisodeLaw:
    none = torch.zeros(0)
    numbers = (torch.tensor(column, dtype=torch.float64) for column in (outcome, probability))
    return EpisodeLaw(*numbers, none, none, none, none)


def test_they_are_those_of_the_table() -> None:
    student = Student(episode_law=lambda levels: TABLE)
    assert float(return_variance(student, None, 1)) == pytest.approx(0.248925)
    for count, best in ((1, 0.42), (2, 0.66796875), (4, 0.886723)):
        assert float(expected_best(TABLE, count)) == pytest.approx(best, abs=1e-6)


def test_the_best_of_ever_more_episodes_is_what_can_be_reached() -> None:
    levels = Level.from_text(["SG", "GS"])
    law = episode_law(levels, UNIFORM.expand(2, 4, 1, 2), NO_VALUES.expand(2, 1, 2), max_steps=25)
    torch.testing.assert_close(expected_best(law, 10**6).float(), optimal_return(levels))


@pytest.mark.parametrize("count", [1, 2, 5])
def test_the_best_of_several_is_the_mean_of_drawn_ones(count: int) -> None:
    outcome, probability = [0.3, -1.0, 0.3, 2.0], [0.1, 0.6, 0.2, 0.1]  # in no order, and a tie
    law = of_returns(outcome, probability)
    generator = torch.Generator().manual_seed(count)
    drawn = torch.multinomial(law.probability, 20000 * count, replacement=True, generator=generator)
    best = law.outcome[drawn].view(-1, count).amax(1)
    assert float(expected_best(law, count)) == pytest.approx(float(best.mean()), abs=0.03)


def first_episodes(rollout: TensorDictBase) -> TensorDictBase:
    """A rollout in which nothing but the first episode of each level ends."""
    done = rollout["next", "done"]
    first = done & (done.long().cumsum(-2) == 1)
    return rollout.copy().set(("next", "done"), first)


def test_scores_of_ever_more_episodes_are_the_exact_ones() -> None:
    """A level in many copies, each scored by so many episodes; the mean has a standard error."""
    ppo = PPOSettings(horizon=8, epochs=1)
    task = tiny_task(solver=SolverSettings(batch_size=2 * COPIES, ppo=ppo))
    learner = task.learner([Streams(0, "solver")])
    two = task.space.sample(2, Streams(5).generator())
    learner.env.set_levels(two.unsqueeze(0).repeat_interleave(COPIES, 1))
    draws = [Streams(0, number).generator() for number in range(EPISODES)]
    rollouts = [first_episodes(learner.collect([draw])) for draw in draws]
    for name in ("max_mc", "one_step_td_error", "return_variance"):
        sampled: Scored = Scorer(name, "episodes").of_rollouts(
            TaskStudent(task, learner), rollouts, unseen((1, 2 * COPIES))
        )
        taught = TaskStudent(task, learner)
        exact = Scorer(name, "exact", EPISODES)(taught, two.unsqueeze(0), [Streams(0)])
        assert taught.evaluations == 2
        shrunk = (EPISODES - 1) / EPISODES if name == "return_variance" else 1
        for each, expected in zip(sampled.score.view(2, -1), exact.score[0] * shrunk, strict=True):
            error = float(each.std()) / math.sqrt(COPIES)
            assert float(each.mean()) == pytest.approx(float(expected), abs=4 * error)


def test_the_largest_spread_of_all_levels_is_a_coins() -> None:
    """However many are asked about at once."""
    count = 2 * AT_ONCE + 5
    variance = torch.rand(2, count, generator=torch.Generator().manual_seed(0)).double() * 0.1
    variance[:, -1] = torch.tensor([0.4, 30.0])
    told = {"success": variance, "return": variance, "spread": variance}
    student = Student(
        exact_performance=lambda places: TensorDict(
            {name: entry.gather(1, places) for name, entry in told.items()}, places.shape
        )
    )
    places = torch.arange(count).expand(2, -1)
    found = Scorer("spread", "exact")(student, places, [Streams(0), Streams(1)]).score
    unit = 4 * torch.tensor([[0.4], [30.0]])
    torch.testing.assert_close(found, variance / unit, check_dtype=False)


def test_learnability_needs_a_task_that_tells_success() -> None:
    blind = Scripted(torch.rand(1, 3), told="return")
    with pytest.raises(NoSuccessError, match="this task tells no success, only the return") as no:
        Scorer("learnability", "exact")(blind, torch.tensor([[0, 1]]), [Streams(0)])
    assert no.value.exit_code == 2

"""Scores of levels against hand-computed tables, a plain loop over episodes and closed forms."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula import Student, TaskStudent, outcome_of
from proposer_rl.curricula.scores import STEPWISE, Scorer, episodes, unseen
from proposer_rl.streams import Streams
from tests.tiny import TASK, evaluate, learners

LEARNER = Student(gamma=0.9, lmbda=0.5)
FIRST = ([-0.01, -0.01, 0.99], [0.7, 0.4, 0.9])
SECOND = ([-0.01, -0.01, 0.99], [0.8, 0.9, 0.6])
SHORT = ([0.99], [0.5])
FAILED = ([-0.01] * 3, [0.2] * 3)
NONE = unseen(1)

Episode = tuple[list[float], list[float]]


def played(*parts: Episode, success: bool = True, after: float = 0.0, cut: int = 0) -> TensorDict:
    """A rollout [1, T] of those episodes.

    Args:
        parts: rewards and values of each.
        success: whether they terminate, rather than are truncated.
        after: the value after the last step of each.
        cut: steps of the last episode that have not been played yet.
    """
    reward = [r for rewards, _ in parts for r in rewards]
    value = [v for _, values in parts for v in values]
    ends = [i == len(rewards) - 1 for rewards, _ in parts for i in range(len(rewards))]
    following = [after if end else v for end, v in zip(ends, [*value[1:], 0.0], strict=True)]
    length = len(reward) - cut

    def column(values: list[Any]) -> Tensor:
        return torch.tensor(values[:length]).view(1, length, 1)

    step = {
        "reward": column(reward),
        "state_value": column(following),
        "done": column(ends),
        "terminated": column([end and success for end in ends]),
    }
    return TensorDict({"state_value": column(value), "next": step}, (1, length))


def score(name: str, *rollouts: TensorDict, best: Tensor = NONE) -> float:
    scorer = Scorer(name, "episodes")
    return float(scorer.of_rollouts(LEARNER, rollouts, best).score)


@pytest.mark.parametrize(
    ("name", "rollout", "expected"),
    [
        ("positive_value_loss", played(FIRST), 0.176833),
        ("l1_value_loss", played(FIRST), 0.227425),
        ("max_mc", played(FIRST), 0.303333),
        ("positive_value_loss", played(SECOND), 0.13),
        ("positive_value_loss", played(FIRST, SHORT), 0.333417),  # 0.255125 over pooled steps
        ("positive_value_loss", played(FAILED, success=True), 0.0),  # nothing is bootstrapped
        ("positive_value_loss", played(FAILED, success=False, after=0.3), 0.02),
        ("max_mc", played(FAILED, success=False), -0.23),  # -0.20 if the maximum began at 0
        ("learnability", played(FIRST, SHORT), 0.0),
        ("yield", played(FIRST, SHORT), 0.0),
        ("regret", played(FIRST, SHORT), 0.01),  # 0.99 - (0.97 + 0.99) / 2
    ],
)
def test_scores_are_those_of_the_table(name: str, rollout: TensorDict, expected: float) -> None:
    assert score(name, rollout) == pytest.approx(expected, abs=1e-6)


def test_the_best_return_of_a_level_is_remembered() -> None:
    best = torch.tensor([0.98])
    assert score("max_mc", played(FIRST), best=best) == pytest.approx(0.313333, abs=1e-6)
    assert score("regret", played(FIRST), best=best) == pytest.approx(0.01, abs=1e-6)
    scorer = Scorer("max_mc", "episodes")
    failed = played(FAILED, success=False)
    found = scorer.of_rollouts(LEARNER, [failed], best)
    assert float(found.best) == pytest.approx(0.98)


def test_only_episodes_that_end_count() -> None:
    whole, cut = played(FIRST), played(FIRST, SECOND, cut=1)
    for name in (*STEPWISE, "regret"):
        assert score(name, cut) == pytest.approx(score(name, whole), abs=1e-6)
    assert score("l1_value_loss", played(FIRST, cut=1)) == -torch.inf


def test_rollouts_are_pooled_by_episodes() -> None:
    failed = played(FAILED, success=False)
    assert score("learnability", played(FIRST, SHORT), failed) == pytest.approx(2 / 9)
    together = score("positive_value_loss", played(FIRST, SHORT))
    assert score("positive_value_loss", played(FIRST), played(SHORT)) == pytest.approx(together)


lists = st.lists(st.tuples(st.integers(1, 5), st.booleans()), min_size=1, max_size=4)


@given(lists, st.integers(0, 4), st.integers(0, 2**31))
def test_episodes_are_those_of_a_plain_loop(
    ends: list[tuple[int, bool]], rest: int, seed: int
) -> None:
    steps = sum(length for length, _ in ends) + rest
    reward = torch.randn(steps, generator=torch.Generator().manual_seed(seed))
    done, terminated = torch.zeros(2, steps, dtype=torch.bool)
    returns, weight, start = [], torch.zeros(steps), 0
    for length, success in ends:
        stop = start + length
        done[stop - 1], terminated[stop - 1] = True, success
        returns.append(float(reward[start:stop].sum()))
        weight[start:stop] = 1 / length
        start = stop
    after = {"reward": reward, "done": done, "terminated": terminated}
    found = episodes(
        TensorDict({"next": {k: v.view(1, -1, 1) for k, v in after.items()}}, (1, steps))
    )
    assert int(found.ended) == len(ends)
    assert int(found.successes) == sum(success for _, success in ends)
    assert float(found.total) == pytest.approx(sum(returns), abs=1e-5)
    assert float(found.best) == pytest.approx(max(returns), abs=1e-6)
    torch.testing.assert_close(found.weight.flatten().float(), weight)


def test_exact_scores_are_those_of_the_definitions() -> None:
    """Of either of two Solvers side by side."""
    learner, levels = learners(2), TASK.space.sample(5, torch.Generator().manual_seed(0))
    known, best = evaluate(learner.agent, levels), TASK.optimal_return(levels).double()
    for copy in range(2):
        chance = known["success"][copy].double()
        for name, expected in (
            ("learnability", chance * (1 - chance)),
            ("regret", best - known["return"][copy].double()),
        ):
            taught = TaskStudent(TASK, learner, copy)
            found = Scorer(name, "exact")(taught, levels, Streams(0))
            assert taught.evaluations == 5
            torch.testing.assert_close(found.score, expected, atol=1e-6, rtol=0)


def test_what_is_played_is_a_share_of_the_episodes_that_ended() -> None:
    learner, levels = learners(1), TASK.space.sample(8, torch.Generator().manual_seed(0))
    scorer = Scorer("learnability", "episodes", rollouts=3)
    taught = TaskStudent(TASK, learner)
    found = scorer(taught, levels, Streams(0), "why")
    assert taught.frames == 3 * 8 * 8
    for batch in range(2):
        some = slice(4 * batch, 4 * batch + 4)
        won, ended = torch.zeros(2, 4)
        for again in range(3):
            learner.env.set_levels(levels[some].unsqueeze(0))
            draws = Streams(0).generator("score", "why", batch, again)
            after = learner.collect([draws])["next"][0]
            won += after["terminated"].sum((-2, -1))
            ended += after["done"].sum((-2, -1))
        share = (won / ended).double()
        torch.testing.assert_close(found.score[some], share * (1 - share), atol=1e-6, rtol=0)


def one_step(reached: Tensor, success: Tensor, value: Tensor) -> TensorDict:
    """A rollout [n, 1] of an episode on each level, all [n]."""
    done = torch.ones(*reached.shape, 1, 1, dtype=torch.bool)
    after = {"done": done, "terminated": done, "success": success.view_as(done)}
    after |= {"reward": reached.view(done.shape), "state_value": torch.zeros(done.shape)}
    return TensorDict(
        {"state_value": value.view(done.shape), "next": after},
        [*reached.shape, 1],
        names=[None, "time"],
    )


def test_without_a_rollout_an_episode_is_a_step_and_the_last_return_the_critic() -> None:
    """As of a rollout of one step, whose value is the return before."""
    reached, value = torch.tensor([0.2, 0.9, -1.0]), torch.tensor([0.5, 0.3, -torch.inf])
    best = torch.tensor([0.5, 0.7, -torch.inf])
    outcome = TensorDict({"return": reached, "success": (reached > 0).float()}, [3])
    known = value.where(value.isfinite(), reached)  # at first there is nothing to learn
    rollout = one_step(reached, reached > 0, known)
    for name in (*STEPWISE, "regret"):
        scorer = Scorer(name, "episodes")
        found = scorer.of_outcome(LEARNER, outcome, best, value)
        expected = scorer.of_rollouts(LEARNER, [rollout], best)
        torch.testing.assert_close(found, expected, msg=name)


def test_of_outcomes_of_several_plays_the_mean_and_the_highest_count() -> None:
    """As of as many rollouts of one step; value losses are those of the mean return."""
    g = torch.Generator().manual_seed(0)
    plays = [torch.rand(5, generator=g) for _ in range(4)]
    before, mean = torch.rand(5, generator=g), torch.stack(plays).mean(0)

    def play(places: Tensor, generator: Any) -> TensorDict:
        reached = next(left)[places]
        ones = torch.ones(places.shape, dtype=torch.int64)
        told = {"return": reached, "success": (reached > 0.5).float()}
        return TensorDict({**told, "episodes": ones, "steps": ones}, places.shape)

    levels, student = torch.arange(5), Student(play=play, batch_size=3)
    for name in (*STEPWISE, "regret", "learnability"):
        of_the_mean = name in STEPWISE.keys() - {"max_mc"}
        rollouts = [one_step(r, r > 0.5, before) for r in ([mean] if of_the_mean else plays)]
        left = iter(plays * 2)  # for the first three levels, and for the others
        scorer = Scorer(name, "episodes", rollouts=4)
        found = scorer(student, levels, Streams(0), before=before)
        expected = scorer.of_rollouts(LEARNER, rollouts, unseen(5))
        torch.testing.assert_close(found.score, expected.score, msg=name)
        torch.testing.assert_close(found.best, torch.stack(plays).amax(0))


def test_learnability_is_of_the_share_that_a_loop_tells_and_scores_are_its_own() -> None:
    outcome = TensorDict({"return": torch.tensor([0.2]), "success": torch.tensor([0.25])}, [1])
    known = torch.tensor([0.5]), torch.tensor([0.5])
    found = Scorer("learnability", "episodes").of_outcome(LEARNER, outcome, *known)
    assert float(found.score) == pytest.approx(0.1875)
    assert float(found.best) == 0.5
    outcome["score"] = torch.tensor([7.0])
    assert float(Scorer("max_mc", "episodes").of_outcome(LEARNER, outcome, *known).score) == 7


def shortfall(student: Student, outcome: TensorDictBase) -> Tensor:
    """A score of one's own: what is missing to a return of one."""
    return 1 - outcome["return"]


DOTTED = f"{__name__}.shortfall"


@pytest.mark.parametrize("own", [shortfall, DOTTED], ids=["function", "name"])
def test_a_score_of_ones_own_is_what_its_function_says_of_the_outcome(own: Any) -> None:
    scorer, known = Scorer(own, "episodes", rollouts=2), (NONE, NONE)
    outcome = outcome_of(played(FIRST))
    assert float(scorer.of_outcome(LEARNER, outcome, *known).score) == pytest.approx(0.03)
    told = TensorDict({"return": torch.tensor([0.25])}, [1])  # by a loop that plays itself
    assert float(scorer.of_outcome(LEARNER, told, *known).score) == 0.75
    unfinished = outcome_of(played(FIRST, cut=1))
    assert float(scorer.of_outcome(LEARNER, unfinished, *known).score) == -torch.inf
    told["score"] = torch.tensor([7.0])
    assert float(scorer.of_outcome(LEARNER, told, *known).score) == 7

    rollouts = iter([played(FIRST), played(SHORT)])  # what is only played is scored by the mean
    found = scorer(Student(play=lambda *_: next(rollouts)), torch.zeros(1), Streams(0))
    assert float(found.score) == pytest.approx((0.03 + 0.01) / 2)
    assert float(found.best) == pytest.approx(0.99)


NUMBERS = r"must return a tensor \[1\] without NaN"


@pytest.mark.parametrize(
    ("score", "source", "message"),
    [
        ("luck", "episodes", "score='luck': from source=episodes there are .*my_module.my_score"),
        ("spread", "exact", r"score='spread': from source=exact there are \['learnability', 'reg"),
        ("my_parts.luck", "episodes", "score=my_parts.luck: No module named 'my_parts'"),
        (f"{__name__}.luck", "episodes", "has no attribute 'luck'"),
        (shortfall, "exact", "score=shortfall: a function of your own needs source=episodes"),
        (3, "episodes", "score=3: input should be a valid string, or callable"),
        (lambda *_: torch.ones(3), "episodes", NUMBERS),
        (lambda *_: 1.0, "episodes", NUMBERS),
        (lambda *_: torch.full((1,), torch.nan), "episodes", NUMBERS),
    ],
)
def test_what_is_no_score_is_refused(score: Any, source: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Scorer(score, source).of_outcome(LEARNER, outcome_of(played(FIRST)), NONE, NONE)

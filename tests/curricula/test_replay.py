"""PLR, robust PLR, ACCEL, NCC, SFL and replay by regret: what is trained on, scored and kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from proposer_rl import curricula as c
from proposer_rl.curricula import buffer as buffers
from proposer_rl.curricula.replay import easiness
from proposer_rl.curricula.scores import unseen
from proposer_rl.learning import PPO, DivergedError
from proposer_rl.streams import Streams
from tests.curricula.living import TASK, live, solvers, student
from tests.curricula.made import MADE, ncc, replay, selection
from tests.curricula.scripted import GivenScores
from tests.tiny import evaluate

P, T = 4, 8


robust, accel = partial(replay, synchronous=False), partial(replay, edits=3)
streams_of = partial(Streams, 0, "update")
B = P * T  # frames of a batch

COSTS: dict[str, tuple[Callable[[], c.Curriculum], list[int], list[int]]] = {
    "one batch is scored beside every update": (replay, [2 * B, B, B, B], [0] * 4),
    "and one of children": (accel, [2 * B, 2 * B, 2 * B, 2 * B], [0] * 4),
    "new ones, and those trained on": (lambda: replay("regret", "exact"), [0] * 4, [2 * P] * 4),
    "all are renewed": (ncc, [0] * 3, [2 * P + 16, P + 16, P + 16]),
    "candidates": (selection, [0] * 5, [16, 0, 0, 16, 0]),
    "played candidates": (lambda: selection("episodes"), [32 * T, 0, 0, 32 * T], [0] * 4),
}


@pytest.mark.parametrize(("make", "frames", "evaluations"), COSTS.values(), ids=COSTS)
def test_scores_cost_what_is_played_or_evaluated(
    make: Callable[[], c.Curriculum], frames: list[int], evaluations: list[int]
) -> None:
    (lived,) = live([make()], solvers([0]), [0], range(len(frames)))
    assert (lived.frames, lived.evaluations) == (frames, evaluations)


@pytest.mark.parametrize("name", ["plr", "plr of regret", "plr of regret, renewed"])
def test_plr_trains_on_new_levels_and_on_old_ones(name: str) -> None:
    curriculum = MADE[name]()
    (lived,) = live([curriculum], solvers([0]), [0], range(12))
    seen: set[int] = set()
    old = []
    for levels in lived.levels:
        keys = set(buffers.level_keys(levels).tolist())
        old.append(len(keys & seen) / len(keys))
        seen |= keys
    assert old[0] == old[1] == 0  # 8 of 16 are to be scored before any is replayed
    assert 1 in old[2:] and min(old[2:]) < 1
    assert set(lived.frames) == {0}
    assert set(curriculum.buffer["key"][curriculum.buffer["filled"]].tolist()) <= seen
    last = lived.levels[2::3]  # of each cycle
    for told, levels in zip(lived.told[1:], last, strict=False):
        if told:  # something has a score
            assert told["distinct_levels"] == len(buffers.level_keys(levels).unique())


def test_robust_plr_trains_on_replayed_levels_alone() -> None:
    curriculum, learner = robust(), solvers([0])
    frames = []
    for number in range(8):
        taught = c.TaskStudent(TASK, learner)
        batch = curriculum.propose(taught, P, streams_of(number))
        known = set(curriculum.buffer["key"][curriculum.buffer["filled"]].tolist())
        assert set(buffers.level_keys(batch.levels).tolist()) <= known
        frames.append(taught.frames)
        learner.env.set_levels(batch.levels.unsqueeze(0))
        update = learner.update([streams_of(number).generator("actions")])
        curriculum.observe(taught, batch, c.outcome_of(update.rollout[0]))
    assert frames[0] >= 2 * P * T and all(cost % (P * T) == 0 for cost in frames)
    assert sum(frames) == T * curriculum.state_dict()["scored"]  # each new level is played once
    assert 0 in frames[1:] and max(frames[1:]) > 0  # q = 0.6


def test_exact_scores_are_of_the_solver_as_it_is_then() -> None:
    """Of levels that were trained on, at the next proposal; the others keep theirs."""
    curriculum, learner = replay("regret", "exact", capacity=8), solvers([0])
    for number in range(4):
        live([curriculum], learner, [0], range(number, number + 1))
        (evidence,) = (curriculum.log(), curriculum.state_dict()["due"])[1]
        slots, keys = evidence["slot"], evidence["key"]
        curriculum.propose(c.TaskStudent(TASK, learner), P, streams_of(99))
        there = curriculum.buffer["key"][slots] == keys  # unless a new one took its place
        levels = curriculum.buffer["level"]
        regret = TASK.optimal_return(levels) - evaluate(learner.agent, levels)["return"][0]
        assert bool(there.any())
        torch.testing.assert_close(
            curriculum.buffer["score"][slots[there]].float(),
            regret[slots[there]],
            atol=1e-5,
            rtol=0,
        )


def test_new_levels_without_a_critic_are_compared_with_what_was_reached_elsewhere() -> None:
    """In a full buffer they take the place of levels on which nothing changes."""
    reached = 0.5

    def play(levels: Any, generator: Any) -> TensorDict:
        return TensorDict({"return": torch.full(levels.shape, reached)}, levels.shape)

    curriculum, taught = replay("l1_value_loss", capacity=8), c.Student(play=play)
    for number in range(4):
        batch = curriculum.propose(taught, P, streams_of(number))
        curriculum.observe(taught, batch, TensorDict({"return": torch.full((P,), 0.5)}, [P]))
    buffer = curriculum.buffer
    assert bool(buffer["filled"].all()) and bool((buffer["score"] == 0).all())
    known, reached = set(buffer["key"].tolist()), 0.75
    curriculum.propose(taught, P, streams_of(4))
    score = dict(zip(buffer["key"].tolist(), buffer["score"].tolist(), strict=True))
    assert [score[key] for key in score.keys() - known] == [0.25] * P


def test_a_level_that_has_left_the_buffer_meanwhile_scores_no_other() -> None:
    curriculum, taught = replay("regret", train_on_new=True, replay_probability=1.0), student(0)
    for number in range(4):
        batch = curriculum.propose(taught, P, streams_of(number))
        outcome = TensorDict({"return": torch.rand(P)}, [P])
        curriculum.observe(taught, batch, outcome)
    batch = curriculum.propose(taught, P, streams_of(4))
    assert bool(batch.notes["replayed"].all())
    gone = batch.notes["slot"][0]
    curriculum.buffer["key"][gone] += 1
    before = curriculum.buffer["score"][gone].clone()
    curriculum.observe(taught, batch, TensorDict({"return": torch.full((P,), -9.0)}, [P]))
    curriculum.log()
    assert (curriculum.buffer["score"][gone] == before).all()


def test_children_differ_from_their_parents_by_their_edits() -> None:
    curriculum = accel(capacity=64)
    live([curriculum], solvers([0]), [0], range(10))
    buffer = curriculum.buffer[curriculum.buffer["filled"]]
    children = buffer[buffer["generation"] > 0]
    assert len(children) > 8 and int(children["generation"].max()) > 1
    found = 0
    for child in children:
        parent = buffer[buffer["key"] == child["parent"]]
        if len(parent):
            found += 1
            level, origin = child["level"], parent["level"][0]
            walls = int((level.walls ^ origin.walls).sum())
            moved = int((level.start != origin.start).any() + (level.goal != origin.goal).any())
            assert 0 < walls + moved <= 3
            assert int(child["generation"]) == int(parent["generation"][0]) + 1
    assert found > 4


def test_easy_parents_are_those_of_the_lowest_return_minus_loss() -> None:
    learner = solvers([0])
    (lived,) = live([replay()], learner, [0], range(1))
    rollout, taught = lived.rollouts[-1], c.TaskStudent(TASK, learner)
    loss = c.Scorer("l1_value_loss", "episodes")
    lost = loss.of_rollouts(taught, [rollout], unseen(P)).score
    easy = easiness(taught, c.outcome_of(rollout))
    after = rollout["next"]
    for p in range(P):
        total, count, reached = 0.0, 0, 0.0
        for step in after[p]:
            total += float(step["reward"])
            if bool(step["done"]):
                reached, count, total = reached + total, count + 1, 0.0
        assert float(easy[p]) == pytest.approx(float(lost[p]) - reached / count)


def test_the_distribution_of_ncc_is_a_softmax_over_renewed_scores() -> None:
    score = torch.tensor([0.25, 0.16, 0.0])
    rule = buffers.ReplayRule(prioritization="softmax", temperature=0.05, staleness=0.0)
    found = buffers.score_weights(score, score >= 0, rule).float()
    torch.testing.assert_close(found, torch.tensor([0.853216, 0.141036, 0.005749]))
    curriculum, learner = ncc(), solvers([0])
    live([curriculum], learner, [0], range(3))
    curriculum.propose(c.TaskStudent(TASK, learner), P, streams_of(3))
    filled = curriculum.buffer["filled"]
    chance = evaluate(learner.agent, curriculum.buffer["level"])["success"][0]
    expected = (chance * (1 - chance))[filled].double()
    found = curriculum.buffer["score"][filled]
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)


def test_the_log_is_of_the_buffer() -> None:
    told = live([accel()], solvers([0]), [0], range(7))[0].told
    assert told[0] == {}
    assert told[-1]["replayed"] == 1 and 1 <= told[-1]["effective_levels"] <= 16


def test_levels_with_nested_entries_are_restored() -> None:
    class Nested:
        def sample(self, count: int, generator: torch.Generator, /) -> TensorDict:
            numbers = torch.rand(count, 3, generator=generator)
            return TensorDict({"wall": {"height": numbers}, "goal": numbers[:, 0]}, [count])

    def made() -> c.ReplayCurriculum:
        return c.ReplayCurriculum(Nested(), c.Scorer("regret", "exact"), capacity=4)

    curriculum, again = made(), made()
    curriculum.buffer = buffers.empty_buffer(Nested().sample(1, torch.Generator())[0], 4)
    again.load_state_dict(curriculum.state_dict())
    assert again.buffer.batch_size == (4,)
    assert again.buffer["level", "wall", "height"].shape == (4, 3)
    assert (again.buffer == curriculum.buffer).all()


def test_where_no_episode_ends_new_levels_are_trained_on_and_none_is_replayed() -> None:
    whole = solvers([0])
    learner = PPO(whole.env, whole.agent, replace(whole.settings, horizon=1))
    curriculum = replay(train_on_new=True, replay_probability=1e-6)
    assert len(live([curriculum], learner, [0], range(4))[0].levels) == 4
    for curriculum in (robust(), replay(train_on_new=True, replay_probability=1.0)):
        with pytest.raises(DivergedError, match=r"on none of 8 new levels did an episode end"):
            live([curriculum], learner, [0], range(4))


def test_the_best_are_kept_and_half_of_a_batch_is_drawn_from_them() -> None:
    curriculum, learner, stream = selection(), solvers([0]), Streams(0, "update", 0)
    taught = c.TaskStudent(TASK, learner)
    levels = curriculum.propose(taught, P, stream)
    candidates = TASK.space.sample(16, stream.generator("candidates"))
    chance = evaluate(learner.agent, candidates)["success"][0]
    worth = [float(p * (1 - p)) for p in chance]
    best = sorted(range(16), key=lambda i: -worth[i])[:6]
    keys = buffers.level_keys(candidates)
    assert buffers.level_keys(curriculum.kept).tolist() == keys[best].tolist()
    drawn = buffers.level_keys(levels).tolist()
    assert all(key in keys[best].tolist() for key in drawn[:2])
    told = curriculum.log()
    assert told["highest_score"] >= told["mean_score"] >= told["lowest_kept_score"]


def test_the_best_that_have_a_score_are_kept() -> None:
    """Levels without one, as where no episode ends within the horizon, are not trained on."""
    curriculum, few = selection(keep=3), torch.full((16,), -torch.inf)
    found = torch.tensor([0.0, 0.25, 0.0, 0.2, 0.0, -torch.inf, 0.1] + [0.0] * 9)
    curriculum.scorer = GivenScores(found)
    curriculum.propose(student(0), P, Streams(0))
    assert curriculum.scores.tolist() == pytest.approx([0.25, 0.2, 0.1])
    few[:2] = 0.1
    curriculum = selection(keep=3)
    curriculum.scorer = GivenScores(few)
    with pytest.raises(DivergedError, match=r"on 2 of 16 .* fewer than 3 have"):
        curriculum.propose(student(0), P, Streams(0))


@pytest.mark.parametrize(("new", "fresh"), [(0.0, 0), (1.0, 4), (0.25, 1)])
def test_the_mixture_is_exact(new: float, fresh: int) -> None:
    curriculum = selection(new=new)
    keys = buffers.level_keys(curriculum.propose(student(0), P, Streams(0)))
    kept = torch.isin(keys, buffers.level_keys(curriculum.kept))
    assert bool(kept[: P - fresh].all()) and len(keys) == P
    if fresh:
        drawn = buffers.level_keys(TASK.space.sample(fresh, Streams(0).generator("levels")))
        assert torch.equal(keys[P - fresh :], drawn)

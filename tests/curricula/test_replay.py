"""PLR, robust PLR, ACCEL, NCC and replay by regret: what is trained on, scored, kept and paid."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from proposer_rl.cli.build import parts
from proposer_rl.curricula import ReplayCurriculum, Scorer, Student, TaskStudent, outcome_of
from proposer_rl.curricula.buffer import (
    ReplayRule,
    empty_buffer,
    level_keys,
    lineage,
    score_weights,
)
from proposer_rl.curricula.replay import easiness
from proposer_rl.curricula.scores import unseen
from proposer_rl.learning import PPO, DivergedError
from proposer_rl.runs.process import StopSignals
from proposer_rl.settings import ArgumentError
from proposer_rl.streams import Streams
from tests.curricula.living import TASK, live, solvers, student
from tests.curricula.made import MADE, ncc, replay
from tests.tiny import composed, evaluate

P, T = 4, 8


def robust(**options: Any) -> ReplayCurriculum:
    return replay(synchronous=False, **options)


def accel(**options: Any) -> ReplayCurriculum:
    return replay(edits=3, **options)


@pytest.mark.parametrize("name", ["plr", "plr of regret", "plr of regret, renewed"])
def test_plr_trains_on_new_levels_and_on_old_ones(name: str) -> None:
    curriculum = MADE[name]()
    lived = live(curriculum, solvers([0]), [0], range(12))
    seen: set[int] = set()
    old = []
    for levels in lived.levels:
        keys = set(level_keys(levels)[0].tolist())
        old.append(len(keys & seen) / len(keys))
        seen |= keys
    assert old[0] == old[1] == 0  # 8 of 16 are to be scored before any is replayed
    assert 1 in old[2:] and min(old[2:]) < 1
    assert set(lived.frames) == {0}
    assert set(curriculum.buffer["key"][curriculum.buffer["filled"]].tolist()) <= seen
    last = lived.levels[2::3]  # of each cycle
    for told, levels in zip(lived.told[1:], last, strict=False):
        if told:  # something has a score
            assert told["distinct_levels"] == [len(level_keys(levels)[0].unique())]


def streams_of(number: int) -> Streams:
    return Streams(0, "update", number)


def test_robust_plr_trains_on_replayed_levels_alone() -> None:
    curriculum, learner = robust(), solvers([0])
    frames = []
    for number in range(8):
        taught = TaskStudent(TASK, learner)
        batch = curriculum.propose(taught, P, [streams_of(number)])
        known = set(curriculum.buffer["key"][curriculum.buffer["filled"]].tolist())
        assert set(level_keys(batch.levels)[0].tolist()) <= known
        frames.append(taught.frames)
        learner.env.set_levels(batch.levels)
        update = learner.update([streams_of(number).generator("actions")])
        curriculum.observe(taught, batch, outcome_of(update.rollout))
    assert frames[0] >= 2 * P * T and all(cost % (P * T) == 0 for cost in frames)
    assert sum(frames) == T * curriculum.state_dict()["scored"]  # each new level is played once
    assert 0 in frames[1:] and max(frames[1:]) > 0  # q = 0.6


def test_the_synchronous_form_scores_one_batch_beside_every_update() -> None:
    frames = live(replay(), solvers([0, 1]), [0, 1], range(5)).frames
    assert frames == [2 * P * T, *[P * T] * 4]
    frames = live(accel(), solvers([0]), [0], range(5)).frames
    assert frames == [2 * P * T, *[2 * P * T] * 4]  # ... and one of children


def test_what_is_exact_costs_evaluations_and_no_frames() -> None:
    lived = live(replay("regret", "exact"), solvers([0]), [0], range(4))
    assert set(lived.frames) == {0}
    assert lived.evaluations == [2 * P, *[2 * P] * 3]  # new ones, and those trained on before


def test_exact_scores_are_of_the_solver_as_it_is_then() -> None:
    """Of levels that were trained on, at the next proposal; the others keep theirs."""
    curriculum, learner = replay("regret", "exact", capacity=8), solvers([0])
    for number in range(4):
        live(curriculum, learner, [0], range(number, number + 1))
        (evidence,) = (curriculum.log(), curriculum.state_dict()["due"])[1]
        slots, keys = evidence["slot"][0], evidence["key"][0]
        curriculum.propose(TaskStudent(TASK, learner), P, [streams_of(99)])
        there = curriculum.buffer["key"][0, slots] == keys  # unless a new one took its place
        levels = curriculum.buffer["level"][0]
        regret = TASK.optimal_return(levels) - evaluate(learner.agent, levels)["return"][0]
        assert bool(there.any())
        torch.testing.assert_close(
            curriculum.buffer["score"][0, slots[there]].float(),
            regret[slots[there]],
            atol=1e-5,
            rtol=0,
        )


def test_new_levels_without_a_critic_are_compared_with_what_was_reached_elsewhere() -> None:
    """In a full buffer they take the place of levels on which nothing changes."""
    reached = 0.5

    def play(levels: Any, generators: Any) -> TensorDict:
        return TensorDict({"return": torch.full(levels.shape, reached)}, levels.shape)

    curriculum, taught = replay("l1_value_loss", capacity=8), Student(play=play)
    for number in range(4):
        batch = curriculum.propose(taught, P, [streams_of(number)])
        curriculum.observe(taught, batch, TensorDict({"return": torch.full((1, P), 0.5)}, [1, P]))
    buffer = curriculum.buffer[0]
    assert bool(buffer["filled"].all()) and bool((buffer["score"] == 0).all())
    known, reached = set(buffer["key"].tolist()), 0.75
    curriculum.propose(taught, P, [streams_of(4)])
    score = dict(zip(buffer["key"].tolist(), buffer["score"].tolist(), strict=True))
    assert [score[key] for key in score.keys() - known] == [0.25] * P


def test_a_level_that_has_left_the_buffer_meanwhile_scores_no_other() -> None:
    curriculum, taught = replay("regret", train_on_new=True, replay_probability=1.0), student(0)
    for number in range(4):
        batch = curriculum.propose(taught, P, [streams_of(number)])
        outcome = TensorDict({"return": torch.rand(1, P)}, [1, P])
        curriculum.observe(taught, batch, outcome)
    batch = curriculum.propose(taught, P, [streams_of(4)])
    assert bool(batch.notes["replayed"].all())
    gone = batch.notes["slot"][0, 0]
    curriculum.buffer["key"][0, gone] += 1
    before = curriculum.buffer["score"][0, gone].clone()
    curriculum.observe(taught, batch, TensorDict({"return": torch.full((1, P), -9.0)}, [1, P]))
    curriculum.log()
    assert curriculum.buffer["score"][0, gone] == before


def test_children_differ_from_their_parents_by_their_edits() -> None:
    curriculum = accel(capacity=64)
    live(curriculum, solvers([0]), [0], range(10))
    buffer = curriculum.buffer[0][curriculum.buffer["filled"][0]]
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


def test_the_lineage_is_the_longest_line_of_edits() -> None:
    buffer = empty_buffer(TASK.space.sample(1, torch.Generator())[0], 1, 6)[0]
    buffer["key"] = torch.tensor([1, 2, 3, 4, 5, 6])
    buffer["parent"] = torch.tensor([3, 0, 2, 1, 99, 5])  # 2 > 3 > 1 > 4, and 5 > 6
    buffer["generation"] = torch.tensor([2, 0, 1, 3, 7, 8])
    assert lineage(buffer, 6).tolist() == [1, 2, 0, 3]


def test_easy_parents_are_those_of_the_lowest_return_minus_loss() -> None:
    learner = solvers([0])
    lived = live(replay(), learner, [0], range(1))
    rollout, taught = lived.updates[-1].rollout, TaskStudent(TASK, learner)
    loss = Scorer("l1_value_loss", "episodes")
    lost = loss.of_rollouts(taught, [rollout], unseen((1, P))).score[0]
    easy = easiness(taught, outcome_of(rollout))
    after = rollout["next"][0]
    for p in range(P):
        total, count, reached = 0.0, 0, 0.0
        for step in after[p]:
            total += float(step["reward"])
            if bool(step["done"]):
                reached, count, total = reached + total, count + 1, 0.0
        assert float(easy[0, p]) == pytest.approx(float(lost[p]) - reached / count)


def test_the_distribution_of_ncc_is_a_softmax_over_renewed_scores() -> None:
    score = torch.tensor([0.25, 0.16, 0.0])
    rule = ReplayRule(prioritization="softmax", temperature=0.05, staleness=0.0)
    found = score_weights(score, score >= 0, rule).float()
    torch.testing.assert_close(found, torch.tensor([0.853216, 0.141036, 0.005749]))
    curriculum, learner = ncc(), solvers([0])
    lived = live(curriculum, learner, [0], range(3))
    assert lived.evaluations == [2 * P + 16, P + 16, P + 16]
    curriculum.propose(TaskStudent(TASK, learner), P, [streams_of(3)])
    filled = curriculum.buffer["filled"][0]
    chance = evaluate(learner.agent, curriculum.buffer["level"][0])["success"][0]
    expected = (chance * (1 - chance))[filled].double()
    found = curriculum.buffer["score"][0][filled]
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)


def test_credit_goes_to_the_levels_trained_on_before() -> None:
    curriculum = MADE["traced"]()
    live(curriculum, solvers([0]), [0], range(4))
    buffer = curriculum.buffer
    slots, before = torch.tensor([[0, 1, 2, 2]]), torch.tensor([[4, 5, 6, 7]])
    keys = buffer["key"].gather(1, before).clone()
    keys[0, 3] += 1  # this one has been evicted since
    curriculum._before = {"slot": before, "key": keys}
    score = buffer["score"].gather(1, slots)
    buffer["score"][0, :3] -= torch.tensor([0.4, 0.8, 0.2])
    expected = buffer["score"][0].clone()
    curriculum._credit(score, slots, torch.tensor([False]))  # trained on new ones
    assert buffer["score"][0].equal(expected)
    curriculum._credit(score, slots, torch.tensor([True]))
    assert curriculum._before["slot"].equal(slots)
    expected[4:7] += 0.5 * (0.4 + 0.8 + 0.2 + 0.2) / 4
    torch.testing.assert_close(buffer["score"][0], expected)


SIZES = [8, 5, 3, 6, 6, 1, 7]


def credited(seeds: list[int], probability: float) -> tuple[ReplayCurriculum, list[Any]]:
    """Batches of many sizes with scores that are told: who was taught, and the scores over time."""
    curriculum = replay(
        "regret",
        train_on_new=True,
        capacity=8,
        replay_probability=probability,
        co_learnability=0.5,
    )
    seen = []
    for number, count in enumerate(SIZES):
        streams = [Streams(seed, number) for seed in seeds]
        batch = curriculum.propose(Student(), count, streams)
        score = torch.stack([torch.rand(count, generator=s.generator("score")) for s in streams])
        before = curriculum.buffer["score"].clone()
        outcome = TensorDict({"return": torch.zeros_like(score), "score": score}, score.shape)
        curriculum.observe(Student(), batch, outcome)
        curriculum.log()
        seen.append((batch, score.double(), before, curriculum.buffer["score"].clone()))
    return curriculum, seen


def test_credit_needs_no_batches_of_one_size() -> None:
    """By a plain loop over the levels of each batch."""
    _, seen = credited([0], 1.0)
    last: set[int] = set()
    raised = 0.0
    for batch, score, before, after in seen[1:]:  # the first one fills the buffer
        assert bool(batch.notes["replayed"].all())
        expected, slots = before[0].tolist(), batch.notes["slot"][0].tolist()
        for slot in {*slots}:
            told = [float(new) for new, where in zip(score[0], slots, strict=True) if where == slot]
            expected[slot] = sum(told) / len(told)
        fell = sum(float(before[0, slot]) - expected[slot] for slot in slots) / len(slots)
        for slot in last:
            expected[slot] += 0.5 * fell
            raised += abs(fell)
        assert after[0].tolist() == pytest.approx(expected)
        last = {*slots}
    assert raised > 1


def test_each_student_gets_its_own_credit() -> None:
    """Where one replays and the other does not, in batches of many sizes."""
    both, seen = credited([0, 1], 0.6)
    assert any(batch.notes["replayed"][:, 0].tolist() in ([0, 1], [1, 0]) for batch, *_ in seen)
    for k in (0, 1):
        alone, _ = credited([k], 0.6)
        assert both.buffer["score"][k].tolist() == alone.buffer["score"][0].tolist()


def test_what_is_logged_shows_levels() -> None:
    told = live(accel(), solvers([0, 1]), [0, 1], range(7)).told
    assert told[0] == {} and set(told[-1]["levels"]) > {"highest scores", "most replayed"}
    assert all(TASK.record(some, None) for some in told[-1]["levels"].values())
    assert told[-1]["replayed"] == 1 and len(told[-1]["effective_levels"]) == 2
    assert all(1 <= n <= 16 for n in told[-1]["effective_levels"])


def test_levels_with_nested_entries_are_restored() -> None:
    class Nested:
        def sample(self, count: int, generator: torch.Generator, /) -> TensorDict:
            numbers = torch.rand(count, 3, generator=generator)
            return TensorDict({"wall": {"height": numbers}, "goal": numbers[:, 0]}, [count])

    def made() -> ReplayCurriculum:
        return ReplayCurriculum(Nested(), Scorer("regret", "exact"), capacity=4)

    curriculum, again = made(), made()
    curriculum.buffer = empty_buffer(Nested().sample(1, torch.Generator())[0], 2, 4)
    again.load_state_dict(curriculum.state_dict())
    assert again.buffer.batch_size == (2, 4)
    assert again.buffer["level", "wall", "height"].shape == (2, 4, 3)
    assert (again.buffer == curriculum.buffer).all()


def test_where_no_episode_ends_new_levels_are_trained_on_and_none_is_replayed() -> None:
    whole = solvers([0])
    learner = PPO(whole.env, whole.agent, replace(whole.settings, horizon=1))
    curriculum = replay(train_on_new=True, replay_probability=1e-6)
    assert len(live(curriculum, learner, [0], range(4)).levels) == 4
    for curriculum in (robust(), replay(train_on_new=True, replay_probability=1.0)):
        with pytest.raises(DivergedError, match=r"on none of 8 new levels did an episode end"):
            live(curriculum, learner, [0], range(4))


def test_several_solvers_cannot_decide_by_themselves_what_to_play_on() -> None:
    with pytest.raises(ValueError, match="set synchronous=true"):
        live(robust(), solvers([0, 1]), [0, 1], range(1))
    config = composed("+method=robust_plr", "+scale=smoke", "+as=dcd", "seeds=[0,1]")
    with pytest.raises(ArgumentError, match="curriculum: 2 Solvers: each would decide by itself"):
        parts(config, StopSignals())  # before anything is written

"""What holds of every curriculum, whatever it proposes."""

from __future__ import annotations

import functools
import io
import json
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from proposer_rl import curricula as c
from proposer_rl.curricula.contract import proposed
from proposer_rl.curricula.ledger import Ledger
from proposer_rl.curricula.student import ABILITIES
from proposer_rl.learning import PPO
from proposer_rl.recipes import CONFIG_FOLDER
from proposer_rl.streams import Streams
from tests.curricula.living import TASK, Lived, live, solvers
from tests.curricula.made import LEARNED, MADE, Make, P
from tests.tiny import mountain_cars, tiny_view_task

EVERY = {**MADE, **LEARNED}
every = pytest.mark.parametrize("make", EVERY.values(), ids=EVERY)
# What differs from another in a score alone, or in where that comes from, remembers the same.
SCORES = {
    *("easy", "regret", "plr of regret", "gradients"),
    *("policy gradients", "sfl from episodes", "filtered from episodes", "filtered perf_gain"),
    *("filtered paired", "filtered schedule", "synchronous"),
}
REMEMBER = [name for name in EVERY if name not in SCORES]


class Past(NamedTuple):
    """What some updates have led to: the state then, and who goes on from there."""

    state: bytes
    snapshot: TensorDict
    life: Lived
    curriculum: c.Curriculum
    learner: PPO


@functools.cache
def lived(name: str) -> Past:
    curriculum, learner = EVERY[name](), solvers([3])
    (life,) = live([curriculum], learner, [3], range(4))  # long enough to fit, replay and score
    file = io.BytesIO()
    torch.save(curriculum.state_dict(), file)
    return Past(file.getvalue(), learner.snapshot(), life, curriculum, learner)


def resumed(name: str, learner: PPO) -> tuple[c.Curriculum, PPO]:
    before = lived(name)
    curriculum = EVERY[name]()
    curriculum.load_state_dict(torch.load(io.BytesIO(before.state), weights_only=True))
    learner.restore(before.snapshot)
    return curriculum, learner


@pytest.mark.parametrize("name", REMEMBER)
def test_restored_from_a_file_it_goes_on_as_if_nothing_had_happened(name: str) -> None:
    again = resumed(name, solvers([5]))
    whole = lived(name).curriculum, lived(name).learner
    (expected,), (found,) = (
        live([curriculum], learner, [3], range(4, 6)) for curriculum, learner in (whole, again)
    )
    for one, other in zip(expected.levels, found.levels, strict=True):
        assert (one == other).all()
    assert (expected.frames, expected.evaluations) == (found.frames, found.evaluations)
    for one, other in zip(expected.told, found.told, strict=True):
        one.pop("levels", None), other.pop("levels", None)
        assert one == other
    assert (again[1].snapshot() == whole[1].snapshot()).all()
    assert same(again[0].state_dict(), whole[0].state_dict())


LOGGING = ["plr", "progress of episodes", "adaptive_mixture", "transport on a model"]


@pytest.mark.parametrize("name", LOGGING)
def test_a_log_is_of_all_since_the_last_one_also_where_it_is_restored_in_between(name: str) -> None:
    whole, learner = resumed(name, shared())
    student = c.TaskStudent(TASK, learner)
    for number in range(2):
        batch = proposed(whole, student, P, Streams(0, "log", number))
        whole.observe(student, batch, played(student, batch, number))
    again = MADE[name]()
    again.load_state_dict(whole.state_dict())
    expected, found = (curriculum.log() for curriculum in (whole, again))
    assert expected == found


@pytest.mark.parametrize("name", REMEMBER)
def test_each_student_lives_as_if_alone(name: str) -> None:
    """Several Solvers in one population get what each would get alone."""
    made = [EVERY[name](), EVERY[name]()]
    _, own = live(made, solvers([4, 3]), [4, 3], range(4))
    alone = lived(name).life
    for together, one in zip(own.levels, alone.levels, strict=True):
        assert (together == one).all()
    assert own.frames == alone.frames and own.evaluations == alone.evaluations


def same(one: Any, other: Any) -> bool:
    """Whether two states are alike, bit by bit."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[k], other[k]) for k in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, torch.Tensor):
        return one.shape == other.shape and bool(
            ((one == other) | ((one != one) & (other != other))).all()
        )
    return bool(one == other)


@functools.cache
def shared() -> PPO:
    """A Solver for tests that train nobody."""
    return solvers([5])


def played(student: c.TaskStudent, batch: c.Batch, number: int) -> TensorDict:
    """What comes of a batch of any size, without training."""
    rollouts = [
        student.play(some, Streams(7, number, i).generator())
        for i, some in enumerate(batch.levels.split(P))
    ]
    return c.outcome_of(torch.cat(rollouts))


def test_results_in_any_order_and_parts_are_observed_in_order() -> None:
    """Of one batch once, whatever came of it; what does not come back keeps nobody waiting."""
    ledger, levels = Ledger({"return": float}), torch.arange(9.0)
    for some in levels.split(4):
        block = ledger.add(c.Batch(some))
        for id in range(block.start, block.end):
            assert ledger.hand_out(id) == id
    observed = []
    for ids in ([8, 5, 2], [6, 0], [3, 1]), ([7],):
        for some in map(np.array, ids):
            ledger.tell(ledger.find(some), {"return": some / 2})
        for batch, told in ledger.take():
            assert (told["return"] == batch.levels.numpy() / 2).all()
            observed.append(batch.levels.tolist())
    assert observed == [[0, 1, 2, 3], [5, 6], [8], [7]] and ledger.out == 1


@every
def test_it_asks_for_what_it_says_whatever_the_size_and_tells_what_came_back(make: Make) -> None:
    """With a student that can do what it needs and nothing else, on batches of any size."""
    curriculum, learner = make(), solvers([0])
    assert curriculum.log() == {}
    whole = c.TaskStudent(TASK, learner)
    can = {name: getattr(whole, name) for name in curriculum.needs}
    student = c.Student(gamma=whole.gamma, lmbda=whole.lmbda, batch_size=P, **can)
    if isinstance(curriculum, c.LearnedCurriculum):
        curriculum.improve(student, Streams(0))
    before = learner.snapshot()
    counts = [1, P + 2]
    for number, count in enumerate(counts):
        batch = proposed(curriculum, student, count, Streams(0, number))
        assert batch.levels.batch_size == (count,)
        outcome = played(whole, batch, number)
        for part in (slice(0, 1), slice(1, None))[:count]:
            curriculum.observe(student, batch[part], outcome[part])
    assert (learner.snapshot() == before).all()  # proposing trains nobody
    told = json.loads(json.dumps(curriculum.log(), allow_nan=False))
    if "histogram" in told:
        assert torch.tensor(told["histogram"]).sum() == sum(counts)
        assert not torch.tensor(curriculum.log().get("histogram", [0])).any()


@every
def test_a_state_of_another_class_is_refused_in_one_line(make: Make) -> None:
    with pytest.raises(ValueError, match=r"^state: has nothing at all, but \w+ needs "):
        make().load_state_dict({"nothing at all": 0})


class Fewer(c.Curriculum):
    def propose(self, student: c.Student, count: int, rng: Streams) -> Any:
        return torch.zeros(count - 1)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: proposed(Fewer(), c.Student(), 4, Streams(0)),
            "curriculum=Fewer: proposes 3 .* 4",
        ),
        (lambda: c.Batch(torch.zeros(3), TensorDict({}, [4])), r"notes: have shape \[4\], .* of 3"),
        (
            lambda: c.Curriculum().propose(c.Student(), 1, Streams(0)),
            "Curriculum must define propose",
        ),
        (lambda: c.Student(sing=print), "sing: unknown; there are: play"),
    ],
)
def test_what_breaks_the_contract_is_refused(call: Any, message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=f"^{message}"):
        call()


@pytest.mark.parametrize(
    "saves", [{}, {"state": ()}, {"state": ("needs",)}, {"state_dict": lambda self: {}}]
)
def test_whoever_observes_and_saves_nothing_is_told_so_once(saves: dict[str, Any]) -> None:
    def observe(self: Any, student: Any, batch: c.Batch, outcome: TensorDictBase) -> None: ...

    own = type("Own", (c.Curriculum,), {"observe": observe, **saves})
    child = type("Child", (own,), {})
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for kind in (own, child, own):
            kind().state_dict()
    told = [str(one.message).partition(" ")[0] for one in said]
    assert told == ([] if saves else ["Own", "Child"])


def test_no_module_hides_a_method() -> None:
    """``proposer_rl.curricula.NAME`` is the method of that name."""
    modules = {path.stem for path in Path(c.__path__[0]).glob("*.py")}
    assert not modules & {path.stem for path in CONFIG_FOLDER.glob("method/*.yaml")}


def test_a_student_that_lacks_something_is_named() -> None:
    cars, windows = mountain_cars(), tiny_view_task()
    for task, need, reason in (
        (cars, "target_direction", "MountainCarTask must define differentiable_performance"),
        (cars, "optimal_return", "MountainCarTask must define optimal_return"),
        (windows, "exact_performance", "ViewMazeTask measures performance by playing, which"),
    ):
        poor = c.TaskStudent(task, task.learner([Streams(0)]))
        c.require(poor, ("play", "probe", "performance"), "plr")
        with pytest.raises(c.UnfitStudentError, match=f"it needs a student with {need}: {reason}"):
            c.require(poor, (need,), "it")
    for name in ABILITIES:
        with pytest.raises(c.UnfitStudentError, match=rf"{name}: it has no {name}\("):
            getattr(c.Student(), name)

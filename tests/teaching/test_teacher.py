"""The teacher in loops of one's own: what goes in comes out, in any order, and what is refused."""

from __future__ import annotations

import copy
import json
import pickle
from collections.abc import Callable
from multiprocessing import util
from multiprocessing.connection import Listener
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import settings as profile
from hypothesis import strategies as st
from torch.utils._pytree import tree_leaves

import proposer_rl as prl
from proposer_rl.curricula import Curriculum
from proposer_rl.settings import ArgumentError
from proposer_rl.teaching.remote import TeacherClient
from tests.curricula.test_contract import same
from tests.teaching.counting import Counting, rollout, through_torch
from tests.tiny import TASK

NAN = float("nan")
SPACE = prl.Parameters(
    {"gravity": (5.0, 25.0), "walls": range(60), "ground": ["flat", "stairs"]},
    bins=4,
    target={"gravity": 25.0, "ground": "stairs"},
    named={"easy": {"walls": range(0, 10)}},
)
ITEMS = prl.Items(100)
ONE: dict[str, Any] = {"slope": (0.0, 8.0)}
SMALL = {"capacity": 32, "fill": 0.25}
PROGRESS = prl.curricula.learning_progress(source="episodes")
MODEL = prl.curricula.model_transport(labels="success")


def plr(**settings: Any) -> prl.Teacher:
    return prl.Teacher(prl.curricula.plr(**{**SMALL, **settings}), SPACE, block=8)


@profile(max_examples=20)
@given(st.data())
def test_whatever_comes_back_reaches_its_own_level(data: st.DataObject) -> None:
    """Against a plain dict: singles, batches and parts, any number outstanding, in any order."""
    spy = Counting("success")
    teacher = prl.Teacher(spy, ITEMS, block=data.draw(st.integers(1, 5)))
    out: dict[int, int] = {}  # ticket to level
    told: dict[int, tuple[float, float]] = {}
    for step in range(data.draw(st.integers(1, 25))):
        do = data.draw(st.sampled_from(["one", "many", "tell", "part", "drop", "resume"]))
        if do == "one":
            ticket, level = teacher.ask()
            assert ticket not in out
            out[ticket] = level
        elif do == "many":
            ids, levels = teacher.ask(data.draw(st.integers(0, 9)))
            assert ids.dtype == torch.int64 and not set(ids.tolist()) & set(out)
            out |= dict(zip(ids.tolist(), levels.tolist(), strict=True))
        elif do == "resume":
            other = prl.Teacher(spy, ITEMS, block=teacher.block)
            other.load_state_dict(through_torch(teacher.state_dict()))
            teacher = other
        elif out:
            few = data.draw(st.integers(1, len(out)))
            some = data.draw(st.permutations(sorted(out)))[: 1 if do == "tell" else few]
            numbers = [out.pop(ticket) for ticket in some]
            if do == "drop":
                teacher.drop(some)
                continue
            returns = [step + number / 8 for number in numbers]
            if do == "tell":
                teacher.tell(some[0], returns[0], True)
            else:
                teacher.tell(torch.tensor(some), returns, [1.0] * len(some))
            told |= {n: (r, 1.0) for n, r in zip(numbers, returns, strict=True)}
    teacher.propose(1)  # takes in what was told
    assert spy.seen == told


FREE = {  # of what needs nothing of a learner, settings that are small
    "domain_randomization": {},
    "target": {},
    "hand_designed": {"distributions": ["easy", "target"], "until": [2]},
    "plr": SMALL,
    "alp_gmm": {"warmup": 16, "refit": 12, "components": 3},
    "learning_progress": {"source": "episodes"},
    "adr": {"episodes": 2},
    "terrain_levels": {},
    "spdl": {"episodes": 8},
    "adaptive_mixture": {},
    "mopps": {},
    "arc_length": {},
    "model_transport": {"probes": 1},
    "mixture": {"parts": {"currot": {"probes": 1}}},
}
SPACES: dict[str, Callable[[], Any]] = {
    "ranges": lambda: SPACE,
    "items": lambda: prl.Items(24, target=[3, 4], named={"easy": [0, 1]}),
    "a task": lambda: TASK,
    "a generator": lambda: prl.LevelGenerator(
        lambda n, g: torch.rand(n, 3, generator=g),
        target=lambda n, g: torch.ones(n, 3),
        named={"easy": lambda n, g: torch.zeros(n, 3)},
    ),
}


def play(teacher: prl.Teacher, rounds: int) -> list[Any]:
    """Both ways of asking; what the levels were."""
    levels = []
    for i in range(rounds):
        ids, several = teacher.ask(5)
        ticket, level = teacher.ask()
        teacher.tell(ticket, 0.1 * i, i % 2)
        teacher.tell(ids[2:], torch.arange(3.0) - i, torch.tensor([True, False, True]))
        levels += [several, level]
        if i % 3 == 0:
            levels.append(teacher.propose(4))
            teacher.observe({"return": [0.0, 1.0, 2.0, float(i)], "success": [0, 1, 0, 1]})
    return levels


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("name", FREE)
def test_whoever_needs_nothing_works_from_returns_and_success(name: str, space: str) -> None:
    """It resumes bit by bit, with tickets that are out."""
    settings = FREE[name]
    if space == "a task" and name == "hand_designed":
        settings = {"distributions": ["id", "id"], "until": [2]}
    recipe = getattr(prl.curricula, name)(**settings)
    bins = {"alp_gmm", "adr", "terrain_levels", "spdl", "learning_progress", "model_transport"}
    bins |= {"mixture", "mopps", "arc_length"}
    if space == "a generator" and name in bins:
        with pytest.raises(ArgumentError, match="draws from bins"):
            prl.Teacher(recipe, SPACES[space]())
        return
    whole = prl.Teacher(recipe, SPACES[space](), block=8, seed=3)
    assert whole.curriculum.needs == ()
    play(whole, 5)
    state = through_torch(whole.state_dict())
    parts = prl.Teacher(recipe, SPACES[space](), block=8, seed=3)
    parts.load_state_dict(state)
    for one, other in zip(play(whole, 3), play(parts, 3), strict=True):
        assert same(plain(one), plain(other))
    assert same(whole.state_dict(), parts.state_dict())
    assert whole.log().keys() == parts.log().keys()
    leaves = tree_leaves(whole.state_dict())  # which checkpoints of any library hold
    assert {type(leaf) for leaf in leaves} <= {torch.Tensor, int, float, str, bool, type(None)}


def plain(levels: Any) -> Any:
    return levels.to_dict() if hasattr(levels, "to_dict") else levels


def ranges(**given: Any) -> prl.Parameters:
    return prl.Parameters(ONE, **given)


def drawn(shape: int) -> prl.LevelGenerator:
    return prl.LevelGenerator(lambda n, g: torch.rand(n, shape, generator=g))


GROUND = ["flat", "stairs", "gap"]
EYE = prl.Items(100, features=torch.eye(100))
ORDERS = [prl.Parameters({"ground": order}) for order in (GROUND, GROUND[::-1])]
OTHERS: dict[str, tuple[Any, Any, str]] = {
    "renamed": (ranges(), prl.Parameters({"angle": (0.0, 8.0)}), "ranges.slope was .*, is missing"),
    "a bit smaller": (ranges(), prl.Parameters({"slope": (0.0, 7.9999999)}), "7.9999999"),
    "other features": (ITEMS, EYE, "feat"),
    "another target": (prl.Items(9, target=[1]), prl.Items(9, target=[2]), r"was \[1\], is \[2\]"),
    "no target": (ranges(target={"slope": 8}), ranges(), "target.slope was .*8.*, is missing"),
    "another order": (*ORDERS, "ranges.ground was .*flat or stairs or gap.*, is .*gap or "),
    "seeds": (ranges(), ranges(seeded=True), "seeded was False, is True"),
    "a shape": (drawn(3), drawn(4), r"level was torch.float32 \[3\], is torch.float32 \[4\]"),
    "a task": (drawn(3), TASK, "kind was LevelGenerator, is "),
}  # fmt: skip


@pytest.mark.parametrize("what", OTHERS)
def test_a_state_of_another_space_is_refused_and_changes_nothing(what: str) -> None:
    before, now, message = OTHERS[what]
    made = prl.curricula.plr(**SMALL)
    state = prl.Teacher(made, before, block=8)
    state.ask(12)
    teacher = prl.Teacher(made, now, block=8)
    teacher.ask(3)
    kept = copy.deepcopy(teacher.state_dict())
    with pytest.raises(
        ArgumentError, match=f"^state: belongs to another space: .*{message}"
    ) as refused:
        teacher.load_state_dict(state.state_dict())
    assert "\n" not in str(refused.value) and same(kept, teacher.state_dict())
    own = prl.Teacher(made, now, block=8)
    own.load_state_dict({**kept, "of": json.loads(json.dumps(kept["of"]))})
    assert same(kept, own.state_dict())


@pytest.mark.parametrize(
    ("before", "now", "message"),
    [
        ("plr", "domain_randomization", "kind was plr, is domain_randomization$"),
        ("model_transport", MODEL, "model.labels was above_w.*, is success"),
    ],
)
def test_a_state_of_another_setting_is_refused(before: Any, now: Any, message: str) -> None:
    state = prl.Teacher(before, SPACE).state_dict()
    with pytest.raises(ArgumentError, match=f"^state: belongs to another curriculum: {message}"):
        prl.Teacher(now, SPACE).load_state_dict(state)


@pytest.mark.parametrize(
    ("size", "comes_back", "block", "expected"),
    [
        (1, True, None, 32),
        (48, True, None, 48),
        (600, True, None, 384),
        (48, False, None, 384),  # tickets that are lost make no larger ones
        (48, True, 20, 20),
    ],
)
def test_a_block_is_what_the_loop_has_out_at_once(
    size: int, comes_back: bool, block: int | None, expected: int
) -> None:
    """In a batch of environments, of which a third ends in every step."""
    spy = Counting()
    teacher = prl.Teacher(spy, prl.Items(10**6), block=block)
    ids, last = teacher.ask(size)[0], 0
    for step in range(200):
        some = (torch.arange(size) + step) % 3 == 0
        if comes_back:
            teacher.tell(ids[some], torch.zeros(int(some.sum())))
        before = spy.count
        ids[some] = teacher.ask(int(some.sum()))[0]
        last = spy.count - before or last
    assert last == expected


LOGGED = ["proposed", "told", "dropped", "out", "mean_return", "mean_success", "drawn"]


@pytest.mark.filterwarnings("ignore:success. told of some levels")
@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("name", ["domain_randomization", "plr"])
def test_a_log_counts_what_went_out_and_came_back(name: str, space: str, tmp_path: Path) -> None:
    """Against counts of the levels themselves."""
    teacher, file = prl.Teacher(name, SPACES[space](), block=8), tmp_path / "log.jsonl"
    ids, _ = teacher.ask(11)
    ticket, _ = teacher.ask()
    teacher.tell(ticket, 3.0)
    teacher.tell(ids[:4], torch.arange(4.0), [1, 1, 0, 1])
    teacher.drop(ids[4:6])
    teacher.propose(5)
    teacher.observe({"return": [1.0] * 5})
    log = teacher.log(file)
    assert [*log][-7:] == LOGGED
    counted = {key: log[key] for key in LOGGED[:6]}
    assert counted == {
        **{"proposed": 17, "told": 10, "dropped": 2, "out": 5},
        **{"mean_return": pytest.approx(1.4), "mean_success": 0.75},
    }
    assert all(sum(bins.values()) == 17 for bins in log["drawn"].values())
    if space == "ranges":
        names = {name: next(iter(bins)) for name, bins in log["drawn"].items()}
        assert names == {"gravity": "5 to 10", "walls": "0 to 14", "ground": "flat"}
    empty = teacher.log(file)
    assert (empty["proposed"], empty["mean_return"], empty["out"]) == (0, None, 5)
    written = [json.loads(line) for line in file.read_text().splitlines()]
    assert written == [
        {"teacher": teacher.id, "levels_told": log["told"]}
        | {k: v for k, v in one.items() if k != "levels"}
        for one in (log, empty)
    ]
    resumed = prl.Teacher(name, SPACES[space](), block=8)
    assert resumed.id != teacher.id
    teacher.drop()
    resumed.load_state_dict(teacher.state_dict())
    assert resumed.id == teacher.id


def test_parameters_are_counted_and_known_each_by_bins_of_its_own() -> None:
    """Against Python's own arithmetic, value by value."""
    lines = {"a": (0.0, 1.0), "n": range(12), "c": [1, 2, 5, 9], "ground": GROUND, "one": [-3.5]}
    space = prl.Parameters(lines, bins={"a": 3, "n": 4})
    teacher = prl.Teacher("domain_randomization", space)
    levels = teacher.propose(100)
    rows = space.rows(levels)
    assert {name: [*bins.values()] for name, bins in teacher.log()["drawn"].items()} == {
        "a": [sum(int(3 * row["a"]) == i for row in rows) for i in range(3)],
        "n": [sum(row["n"] // 3 == i for row in rows) for i in range(4)],
        "c": [sum(row["c"] == value for row in rows) for value in (1, 2, 5, 9)],
        "ground": [sum(row["ground"] == text for row in rows) for text in GROUND],
        "one": [100],
    }
    expected = [
        [3 * row["a"] - 1.5, (row["n"] - 1) / 4.5 - 1, (row["c"] - 1) / 4 - 1]
        + [row["ground"] == text for text in GROUND]
        + [0]
        for row in rows
    ]
    known = torch.tensor(expected, dtype=torch.float64)
    torch.testing.assert_close(space.inputs(levels), known.reshape(100, -1))


def hills(values: Any, generator: torch.Generator) -> torch.Tensor:
    noise = torch.rand(len(values), 1, generator=generator, dtype=torch.float64)
    return values["slope"].unsqueeze(-1) * torch.arange(3) + noise


def test_made_levels_have_bins_a_target_and_edits() -> None:
    space = prl.MadeLevels(ONE, hills, bins=4, target={"slope": (6.0, 8.0)})
    assert space.target_shares.tolist() == [0, 0, 0, 1]
    steep = prl.Teacher("target", space).propose(64)
    assert steep.shape == (64, 3) and float((steep[:, 1] - steep[:, 0]).min()) >= 6
    _, level = prl.Teacher("plr", space).ask()
    assert level.shape == (3,)
    g = [torch.Generator()]
    old = space.generate(torch.tensor([[0, 3]]), g)
    new = space.edit(old, 3, g)
    for one in (old, new, space.at(torch.tensor([[[0.5], [-1.0]]]), g)):
        rise = one["level"][..., 2] - one["level"][..., 1]
        torch.testing.assert_close(rise, one["slope"].float())
    assert (old["slope"] != new["slope"]).all()
    model = prl.MadeLevels(ONE, hills, features=lambda levels: levels[..., :1])
    assert model.features(old).shape == (1, 2, 1)


def test_many_parameters_have_one_bin_each() -> None:
    ranges = {f"friction_{i}": (0.0, 1.0) for i in range(21)}
    with pytest.raises(ValueError, match="combinations of their bins"):  # 8 ** 21
        prl.Parameters(ranges)
    _, level = prl.Teacher("plr", prl.Parameters(ranges, bins=1)).ask()
    assert level.keys() == ranges.keys()


def test_every_update_has_draws_of_its_own() -> None:
    """One ``Streams(0)`` at each update gives the same levels for ever; here there is none."""
    teacher = prl.Teacher(prl.curricula.domain_randomization(), SPACE)
    first, second = teacher.propose(8), teacher.propose(8)
    assert not (first["gravity"] == second["gravity"]).any()
    other = prl.Teacher(prl.curricula.domain_randomization(), SPACE)
    assert (other.propose(8) == first).all()
    third = prl.Teacher(prl.curricula.domain_randomization(), SPACE, seed=1).propose(8)
    assert not (third["gravity"] == first["gravity"]).any()


def observe(teacher: prl.Teacher, **outcome: Any) -> None:
    teacher.propose(4)
    teacher.observe(outcome)


ZEROS = [0.0] * 4
NONE = {"return": ZEROS, "success": ZEROS}
MASKED = np.ma.array([0.0, 1.0], mask=[False, True])


def ended(*rewards: float) -> Callable[[prl.Teacher], Any]:
    """Observes an episode of a rollout on the level of the first ticket."""
    played = rollout([rewards])
    played["next", "success"] = played["next", "done"]
    return lambda teacher: teacher.observe(prl.outcome_of(played), ids=0)


REFUSED: dict[str, tuple[Callable[[prl.Teacher], Any], str]] = {
    "a ticket that was never given": (lambda t: t.tell(99, 0.0, 1), "ids=99: "),
    "one that is not out yet": (lambda t: t.tell(6, 0.0, 1), "ids=6: "),
    "told twice": (lambda t: [t.tell(0, 0.0, 1)] * 2 and t.tell(0, 0.0, 1), "ids=0: "),
    "twice at once": (lambda t: t.tell([1, 0, 1], [0.0] * 3, [1] * 3), "ids=1: "),
    "not finite, several": (lambda t: t.tell([0, 1], [0.0, NAN], [1, 1]), "return_=nan: must be"),
    "masked among others": (lambda t: t.tell([0, 1], [0.0, np.ma.masked], [1, 1]), "return_=nan"),
    "masked tickets": (lambda t: t.tell(MASKED.astype(int), [0.0, 1.0], [1, 1]), "ids=.*: must be"),
    "no success": (lambda t: t.tell(0, 1.0), "success: missing: this curriculum requires it; tell"),
    "no episodes": (lambda t: t.tell(0, 1.0, 1, episodes=0), "episodes=0.0: must be a whole"),
    "a state while tickets are out": (lambda t: t.load_state_dict(t.state_dict()), "state: level"),
    "observed before it was proposed": (lambda t: t.observe(NONE), "ids: missing: nothing is out"),
    "two batches": (lambda t: [t.propose(4), t.propose(4), t.observe(NONE)], "ids: missing: 2"),
    "a rollout of one step": (
        lambda t: observe(t, **{"return": [[0.0] * 3] * 4, "success": ZEROS}),
        r"return_: has shape \[4, 3\], but must have \[4\]",
    ),
    "an integer": (lambda t: t.tell(0, 10**400, 1), "return_=1000.*: must be numbers of float32"),
    "complex ones": (lambda t: t.tell([0], torch.tensor([1j]), 1), "return_=.*: must be numbers"),
    "a truth value as a ticket": (lambda t: t.tell(True, 0, 1), "ids=True: must be whole"),
    "a rollout's sum": (ended(3e38, 3e38), "return_=inf: must be finite"),
    "no return": (lambda t: t.tell(0, None, 1), "return_=nan: must be finite"),
    "a result that there is not": (lambda t: observe(t, **NONE, sucess=ZEROS), "outcome.sucess"),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_what_is_wrong_is_named_and_counts_nothing(what: str) -> None:
    teacher = prl.Teacher(PROGRESS, SPACE, block=8)
    tickets = [teacher.ask()[0] for _ in range(6)]
    wrong, message = REFUSED[what]
    with pytest.raises(ArgumentError, match=message) as refused:
        wrong(teacher)
    assert "\n" not in str(refused.value)
    # It is as it was, and goes on.
    left = [ticket for ticket in tickets if what != "told twice" or ticket]
    teacher.tell(left, torch.ones(len(left)), torch.ones(len(left)))
    teacher.ask(20)
    assert torch.tensor(teacher.log()["histogram"]).sum() == 6


def test_a_rollout_without_success_is_refused_where_termination_may_be_failure() -> None:
    """Falling early terminates, surviving does not: [True, False] would be wrong."""

    fell = torch.zeros(2, 3, 1, dtype=torch.bool)
    fell[0, 1] = True
    played = rollout(torch.ones(2, 3))
    ends = played["next", "done"] | fell
    played["next"].update({"done": ends, "terminated": fell, "truncated": ends & ~fell})

    def reached(**how: Any) -> list[float]:
        teacher = prl.Teacher(PROGRESS, SPACE, **how)
        teacher.propose(2)
        teacher.observe(prl.outcome_of(played))
        teacher.ask(1)  # what came in is taken in
        known = teacher.curriculum.scores["fast"]
        return sorted(known[known.isfinite()].tolist())

    with pytest.raises(ArgumentError, match=r"success: missing: .* for rollouts, Teacher"):
        reached()
    assert reached(success="truncated") == reached(
        success=lambda after: after["done"] & ~after["terminated"]
    )


@pytest.mark.parametrize("score", ["l1_value_loss", "max_mc"])
def test_a_rollout_without_values_is_refused_where_they_are_read(score: str) -> None:
    teacher = prl.Teacher(prl.curricula.plr(score=score), SPACE)
    teacher.propose(1)
    teacher.observe(prl.outcome_of(rollout([[1.0]])))
    with pytest.raises(ArgumentError, match=r"^rollout: .*state_value"):
        teacher.propose(1)


def test_a_curriculum_of_ones_own_must_propose_what_was_asked_for() -> None:
    class Short(Curriculum):
        def propose(self, student: Any, count: int, rng: Any) -> Any:
            return SPACE.sample(3, torch.Generator())

    with pytest.raises(ArgumentError, match=r"^curriculum=Short: proposes 3 levels where 4"):
        prl.Teacher(Short(), SPACE).propose(4)


def test_a_copy_in_another_process_is_refused() -> None:
    teacher = plr()
    for copied in (pickle.dumps, copy.deepcopy):
        with pytest.raises(TypeError, match=r"send teacher\.client"):
            copied(teacher)


def solved(levels: Any) -> dict[str, Any]:
    """A student whose success falls with the number of walls."""
    success = 1 - levels["walls"] / 60
    return {"return": success, "success": success}


def episodes(levels: Any, generator: torch.Generator) -> dict[str, Any]:
    success = torch.rand(len(levels), generator=generator) < solved(levels)["success"]
    return {"return": success.float(), "success": success}


C = prl.curricula
ALL_SOLVE = {"exact_performance": solved, "optimal_return": lambda levels: torch.ones(len(levels))}
CAN: dict[str, tuple[Any, dict[str, Any]]] = {
    "sfl": (C.sfl(candidates=64, keep=8), {"exact_performance": solved}),
    "sfl from episodes": (
        C.sfl(source="episodes", rollouts=16, candidates=64, keep=8),
        {"play": episodes},
    ),
    "currot": (C.currot(probes=2), {"performance": solved}),
    "robust_plr": (C.robust_plr(score="max_mc", **SMALL), {"play": episodes}),
    "accel": (C.accel(score="regret", **SMALL), {"play": episodes}),
    "regret": (C.regret(**SMALL), ALL_SOLVE),
    "ncc": (C.ncc(capacity=16), {"exact_performance": solved}),
    "learning_progress": (C.learning_progress(probes=2), {"performance": solved}),
}


@pytest.mark.parametrize("name", CAN)
def test_functions_of_levels_are_all_that_others_need(name: str) -> None:
    recipe, can = CAN[name]
    teacher = prl.Teacher(recipe, SPACE, block=8, **can)
    for _ in range(6):
        ids, levels = teacher.ask(8)
        teacher.tell(ids, **{f"{k}_" if k == "return" else k: v for k, v in solved(levels).items()})
    if name.startswith("sfl"):
        walls = teacher.curriculum.kept["walls"].double().mean()
        assert 18 < float(walls) < 42  # p (1 - p) is largest in the middle


@pytest.mark.parametrize("space", [SPACE, ITEMS])
def test_functions_get_levels_where_the_loop_has_them(space: Any) -> None:
    """Here the device is one that holds no numbers."""
    seen = []

    def performance(levels: Any) -> dict[str, Any]:
        seen.append(levels.device.type)
        return {"return": [0.5] * len(levels), "success": [0.5] * len(levels)}

    recipe = prl.curricula.learning_progress(probes=1)
    teacher = prl.Teacher(recipe, space, device="meta", performance=performance)
    assert teacher.propose(4).device.type == "meta" and {*seen} == {"meta"}


def test_filtering_works_on_spaces() -> None:
    teacher = prl.Teacher(
        "domain_randomization", SPACE, filter="learnability", exact_performance=solved
    )
    walls = teacher.propose(256)["walls"].double()
    assert float((walls - 29.5).abs().mean()) < 11  # of uniform draws it is 15


def test_a_model_reads_success_where_it_is_asked_to() -> None:
    """The same settings by a recipe and by a filter, as below the key ``model`` of a run."""
    recipe = prl.curricula.model_transport(labels="success", half_life=5, probes=1)
    model = {"labels": "success", "ridge": 0.3, "half_life": 5}
    around: dict[str, Any] = {"labels": "success", "half_life": 5, "times": 3}
    for teacher in (
        prl.Teacher(recipe, SPACE),
        prl.Teacher("plr", SPACE, filter=around),
        prl.Teacher("model_transport", SPACE, filter=around),
    ):
        assert (
            teacher.required_results == ("success",)
            and teacher.state_dict()["of"]["curriculum"]["model"] == model
        )
    own = {"labels": "success", "half_life": 5}
    assert recipe.settings == {"model": own, "curriculum": {"probes": 1}}


def test_a_score_from_gradients_says_what_it_lacks_and_takes_a_function() -> None:
    recipe = prl.curricula.plr(score="gradient_norm", **SMALL)
    with pytest.raises(TypeError, match=r"plr needs a student with policy_gradient_norms: it has"):
        prl.Teacher(recipe, SPACE)
    seen = []

    def norms(played: Any) -> torch.Tensor:
        seen.append(played.batch_size)
        return played["gravity"][..., 0]

    teacher = prl.Teacher(recipe, SPACE, policy_gradient_norms=norms)
    levels = teacher.propose(8)
    played = rollout(torch.zeros(8, 3), gravity=levels["gravity"].expand(3, 8).mT)
    teacher.observe(prl.outcome_of(played))
    teacher.propose(1)
    assert teacher.log()["mean_score"] == pytest.approx(float(levels["gravity"].mean()))
    assert seen == [(8, 3)]


def test_a_client_says_that_its_teacher_has_ended() -> None:
    listener = Listener()
    client = TeacherClient(listener.address, b"", ())
    listener.close()
    for _ in range(2):
        with pytest.raises(RuntimeError, match="the process of the teacher has ended"):
            client.ask()


def test_clients_where_the_temporary_folder_has_a_long_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / ("job_" * 30)
    folder.mkdir()
    monkeypatch.setattr(util, "get_temp_dir", lambda: str(folder))
    client = pickle.loads(pickle.dumps(plr().client()))
    ticket, _ = client.ask()
    client.tell(ticket, 0.5)
    with pytest.raises(ArgumentError, match="told before"):
        client.tell(ticket, 0.5)

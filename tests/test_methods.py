"""What a curriculum's class or function gets of its settings, and of what the run has."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

import proposer_rl as prl
from proposer_rl.curricula import Curriculum, SamplingCurriculum, Student
from proposer_rl.meta.assembly import Components, ProposerSettings
from proposer_rl.methods import build, completed
from proposer_rl.settings import ArgumentError, Count
from proposer_rl.streams import Streams


def run_of(task: Any) -> Components:
    return Components(task, ProposerSettings(), 3)


RUN = run_of(SimpleNamespace(space="the space", target="the target"))


class OfSpace(Curriculum):
    """Takes the space, as curricula do that do not say otherwise."""

    def __init__(self, space: Any, *, every: Count = 2, score: str) -> None:
        self.got: Any = space, every, score


class OfTarget(OfSpace):
    """Says what it takes, and has a setting that the constructor has not."""

    @classmethod
    def create(cls, run: Components, *, times: Count = 3, **settings: Any) -> OfTarget:
        return cls((run.task.target, run.optional("edit"), times), **settings)


def of_run(run, *, probability: float, more: tuple[int, ...] = (1, 2)) -> Curriculum:
    return OfSpace((run, probability, more), score="")


def of_any(run: Components, **settings: Any) -> Curriculum:
    return OfSpace(settings, score="")


def asks_of_another(run: Components) -> int:
    return (0).x  # type: ignore[attr-defined]


def made(target: Any, **settings: Any) -> Any:
    return {"curriculum": {"_target_": f"{__name__}.{target.__name__}", **settings}}


def test_it_is_called_with_the_run_and_its_settings() -> None:
    assert build(made(OfSpace, score="a"), RUN).got == ("the space", 2, "a")
    assert build(made(OfTarget, score="a", every=5), RUN).got == (("the target", None, 3), 5, "a")
    assert build(made(of_run, probability=1), RUN).got[0] == (RUN, 1.0, (1, 2))
    assert build(made(of_any, x=1), RUN).got[0] == {"x": 1}


def test_what_is_stored_has_every_default() -> None:
    whole = completed(made(OfTarget, score="a"))["curriculum"]
    assert whole == made(OfTarget, times=3, every=2, score="a")["curriculum"]
    assert completed(made(of_run, probability=1))["curriculum"]["more"] == [1, 2]  # as JSON has it
    around = completed({**made(OfSpace), "filter": {"times": 8}, "model": None})
    assert around["filter"]["times"] == 8 and around["filter"]["rollouts"] == 8
    assert around["model"] is None and "score" not in around["curriculum"]


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (made(OfSpace, space=1), "^curriculum.space: unknown; there are: every, score$"),
        (made(OfTarget, tims=1), "^curriculum.tims: unknown; there are: times, every, score$"),
        (made(OfTarget, times=0, score="a"), "^curriculum.times=0: input should be"),
        (made(OfSpace), "^curriculum.score: missing$"),
        ({"curriculum": {}}, "^curriculum._target_: missing"),
        ({**made(OfSpace, score="a"), "filter": {"times": 1}}, "^filter.times=1: input should"),
        ({**made(OfSpace, score="a"), "model": {"time": 1}}, "^model.time: unknown; there are: la"),
    ],
)
def test_settings_that_are_not_allowed_are_refused(config: Any, message: str) -> None:
    with pytest.raises(ArgumentError, match=message):
        build(config, RUN)


def test_what_a_task_lacks_is_named_and_other_errors_are_as_they_are() -> None:
    with pytest.raises(ArgumentError, match="needs target of a task, which SimpleNamespace does"):
        build(made(OfTarget, score="a"), run_of(SimpleNamespace()))
    with pytest.raises(AttributeError, match="'int' object has no attribute 'x'"):
        build(made(asks_of_another), RUN)


def mixture(parts: Any, **rest: Any) -> Curriculum:
    """The mixture of a run on ranges."""
    asked = {"_target_": "proposer_rl.methods.mixture", "parts": parts}
    return build({"curriculum": asked, **rest}, run_of(RANGES))


RANGES = prl.Parameters({"x": (0.0, 1.0)}, target={"x": 1.0})
OFF = ("domain_randomization", "target", "currot")  # the mixture's own


def test_a_mixture_is_what_its_methods_propose_by_themselves() -> None:
    parts: dict[str, dict[str, Any]] = {
        "target": {},
        "domain_randomization": {"share": 2},
        "alp_gmm": {"share": 0},
        "learning_progress": {"source": "episodes", "exploration": 1.0},
    }
    made = mixture(parts)
    assert made.needs == () and made.required_results == ("success",)
    drawn = made.propose(Student(), 40, Streams(0)).levels["x"]
    assert (drawn[:10] == 1).all()
    alone = SamplingCurriculum(RANGES).propose(Student(), 20, Streams(0, "part", 1))
    assert (drawn[10:30] == alone["x"]).all()
    assert (drawn[30:] * 8).long().bincount(minlength=8).tolist().count(1) == 6  # 10 in 8 bins


def test_the_mixture_of_thirds_asks_one_model_of_success_and_nobody_else() -> None:
    teacher = prl.Teacher(prl.curricula.mixture(parts={"currot": {"every": 2}}), RANGES)
    assert teacher.curriculum.needs == () and teacher.required_results == ("success",)
    for _ in range(6):
        drawn = teacher.propose(60)["x"]
        assert (drawn[20:40] == 1).all()
        teacher.observe({"return": drawn, "success": 1 - drawn})
    uniform, transport = drawn[:20], drawn[40:]
    assert float((uniform - 0.5).abs().mean()) < 0.2  # the most learnable; of all it is 0.25
    assert 0.5 < float(transport.mean()) < 0.85  # where success is at least delta, 0.2


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"plrr": {}}, r"^curriculum.parts.plrr: unknown; there are: accel, "),
        (
            {"plr": {}},
            "^curriculum.parts.plr.curriculum: Interpolation key 'pool.capacity' not found",
        ),
        (
            {"target": {"share": 0}},
            r"^curriculum.shares=\[\]: list should have at least 1 item",
        ),
        ({"target": {"name": 0}}, "^curriculum.parts.target.name: unknown; there are: none$"),
        (
            {"alp_gmm": {"refit": 0}},
            "^curriculum.parts.alp_gmm.curriculum.refit=0: input",
        ),
        ({"target": {"filter": "no"}}, "^curriculum.parts.target.filter/no: unknown; there are"),
    ],
)
def test_a_part_that_is_not_allowed_is_named(parts: Any, message: str) -> None:
    with pytest.raises(ArgumentError, match=message) as refused:
        prl.Teacher(
            prl.curricula.mixture(parts={**{name: {"share": 0} for name in OFF}, **parts}), RANGES
        )
    assert "\n" not in str(refused.value)

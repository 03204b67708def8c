"""What a curriculum's class or function gets of its settings, and of what the run has."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

import proposer_rl as prl
from proposer_rl.curricula import ReplayRule, SamplingCurriculum, Scorer, Student
from proposer_rl.meta.assembly import ProposerSettings
from proposer_rl.methods import Components, UnfitTaskError, filtered, make, mixture, target
from proposer_rl.settings import ArgumentError, Count
from proposer_rl.streams import Streams

TASK = SimpleNamespace(space="the space", target="the target", edit=abs)
RUN = Components(TASK, ProposerSettings(), [3])  # type: ignore[arg-type]


class Own:
    """What it is made of."""

    def __init__(self, space: Any, *, every: Count = 2, edit: Any = None, seeds: Any = ()) -> None:
        self.got = space, every, edit, seeds


class Scoring:
    """What it is made of."""

    def __init__(self, target: Any, scorer: Scorer, rule: ReplayRule | None = None) -> None:
        self.got = target, scorer.rollouts, rule


def of_a_run(parts, probability: float, target: float = 0.5) -> Any:
    return parts, probability, target


def of_components(run: Components, **settings: Any) -> Any:
    return run, settings


def of_settings(probability: float, features: Any = "none") -> Any:
    return probability, features


def test_it_gets_by_name_what_the_run_has_and_what_it_lacks_by_default() -> None:
    assert make(Own, {}, RUN).got == ("the space", 2, abs, [3])
    assert make(Own, {"every": 5}, RUN, edit=max).got == ("the space", 5, max, [3])
    bare = Components(SimpleNamespace(space=1), ProposerSettings(), [3])  # type: ignore[arg-type]
    assert make(Own, {}, bare).got == (1, 2, None, [3])
    assert make(of_settings, {"probability": 1}, RUN) == (1.0, "none")


def test_parts_are_made_of_the_settings_that_they_take() -> None:
    settings = {"score": "regret", "source": "exact", "rollouts": 3, "temperature": 2}
    assert make(Scoring, settings, RUN).got == ("the target", 3, ReplayRule(temperature=2))


def test_a_first_parameter_of_no_such_name_is_the_run() -> None:
    assert make(of_a_run, {"probability": 1}, RUN) == (RUN, 1.0, 0.5)
    assert make(of_components, {"x": 1}, RUN) == (RUN, {"x": 1})


@pytest.mark.parametrize(
    ("made", "settings", "message"),
    [
        (Own, {"every": 0}, "^every=0: input should be"),
        (Own, {"space": 1}, "^space: unknown; there are: every$"),
        (Scoring, {"scoer": 1}, "^scoer: unknown; there are: score, source, rollouts, priorit"),
        (Scoring, {"score": "regret"}, "^source: missing$"),
        (Scoring, {"score": "regret", "source": "luck"}, "^source='luck': input should be"),
        (of_settings, {}, "^probability: missing$"),
    ],
)
def test_settings_that_are_not_allowed_are_refused(made: Any, settings: Any, message: str) -> None:
    with pytest.raises(ArgumentError, match=message):
        make(made, settings, RUN)


def test_what_a_task_lacks_is_named_and_other_errors_are_as_they_are() -> None:
    bare = Components(SimpleNamespace(), ProposerSettings(), [0])  # type: ignore[arg-type]
    with pytest.raises(UnfitTaskError, match="needs target of a task, which SimpleNamespace does"):
        make(target, {}, bare)
    with pytest.raises(AttributeError, match="'int' object has no attribute 'x'"):
        make(lambda space: (0).x, {}, RUN)  # type: ignore[attr-defined]
    with pytest.raises(ArgumentError, match=r"^times=1: "):
        filtered(None, {"times": 1}, RUN)  # type: ignore[arg-type]


RANGES = prl.Parameters({"x": (0.0, 1.0)}, target={"x": 1.0})
OFF = ("domain_randomization", "target", "currot")  # the mixture's own
ON_RANGES = Components(RANGES, ProposerSettings(), [3])  # type: ignore[arg-type]


def test_a_mixture_is_what_its_methods_propose_by_themselves() -> None:
    parts: dict[str, dict[str, Any]] = {
        "target": {},
        "domain_randomization": {"share": 2},
        "alp_gmm": {"share": 0},
        "learning_progress": {"source": "episodes", "exploration": 1.0},
    }
    made = mixture(ON_RANGES, parts)
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
        ({"plrr": {}}, r"^parts.plrr: unknown; there are: accel, "),
        ({"plr": {}}, r"^parts.plr.capacity: missing; alone the method has that of pool.capacity$"),
        ({"target": {"share": -1}}, "^parts.target.share=-1: input should be"),
        ({"target": {"share": 0}}, r"^parts=.*'target'.*: must have one whose share is above 0$"),
        ({"target": {"name": 0}}, "^parts.target.name: unknown; there are none$"),
        ({"alp_gmm": {"refit": 0}}, "^parts.alp_gmm.refit=0: input should be"),
        ({"target": {"filter": "no"}}, "^parts.target.filter='no': must be one of"),
        ({"target": 1}, "^parts.target=1: input should be an object"),
    ],
)
def test_a_part_that_is_not_allowed_is_named(parts: Any, message: str) -> None:
    with pytest.raises(ArgumentError, match=message) as refused:
        prl.Teacher(
            prl.curricula.mixture(parts={**{name: {"share": 0} for name in OFF}, **parts}), RANGES
        )
    assert "\n" not in str(refused.value)

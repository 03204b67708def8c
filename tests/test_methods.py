"""What a curriculum's class or function gets of its settings, and of what the run has."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from proposer_rl.curricula import ReplayRule, Scorer
from proposer_rl.meta.assembly import ProposerSettings
from proposer_rl.methods import Components, UnfitTaskError, filtered, make, target
from proposer_rl.settings import ArgumentError, Count

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

"""Bounds stand in the signatures, which one validator holds; here is what each curriculum asks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDict

import proposer_rl as prl
from proposer_rl import curricula as c
from proposer_rl.meta.actions import Mixture
from proposer_rl.meta.first_order import target_performance
from proposer_rl.meta.rewards import TrainingStep, log_success_gain
from proposer_rl.settings import ArgumentError
from proposer_rl.streams import Streams
from proposer_rl.task import NoSuccessError
from proposer_rl.tasks.parameters import ParameterSpace, intervals
from tests.curricula.made import SETTINGS, SPACE, TARGET, problem_agent, replay
from tests.curricula.scripted import GivenScores, Scripted, step

TWO: list[c.Curriculum] = [c.SamplingCurriculum(SPACE)] * 2
ONE, MANY, SEEDS = (ParameterSpace({"x": intervals(0, 1, n)} if n else {}) for n in (1, 5000, 0))
WIDE = ParameterSpace({str(axis): intervals(0.0, 1.0, 8) for axis in range(9)})
HUGE = {str(axis): intervals(0.0, 1.0, 256) for axis in range(8)}
ONE_RATE = prl.Items(2, pass_rates=[0.5, float("nan")])
ONE_ROW = prl.Parameters({"row": (0.0, 1.0)}, bins=1)
gaussians = partial(c.MixtureCurriculum, SPACE, refit=64, warmup=64)
rounded = partial(c.MixtureCurriculum, refit=64, warmup=64)
bounds, rows = partial(c.BoundsCurriculum, SPACE), partial(c.RowsCurriculum, SPACE)
no_edits = partial(c.ReplayCurriculum, SPACE, c.Scorer("positive_value_loss", "episodes"))
schedule = partial(c.Schedule, [*TWO, TWO[0]])
# PAIRED's generator is its twin.
first_order = partial(
    c.FirstOrderProposer, target=TARGET, agent=problem_agent(), settings=SETTINGS,
    target_levels=3, step=1.0, measure="return",
)  # fmt: skip
SINGLE, TOO_MANY = "^space: 1 bins: must be 2 to", "134,217,728 bins: must be 2 to 100,000,000"

REFUSED: list[tuple[Callable[..., Any], dict[str, Any], str]] = [
    (gaussians, {"components": 65}, "components=65: must be at most refit=64, and that at most"),
    (gaussians, {"warmup": 63}, "components=10: must be at most refit=64, .* at most warmup=63"),
    (bounds, {"start": {"place": 0.0}}, "start.place: unknown; there are: obstacle fraction, path"),
    (bounds, {"lower": 0.6}, "lower=0.6: must be at most upper=0.5"),
    (rows, {"lower": 0.6}, "lower=0.6: must be at most upper=0.5"),
    (rows, {"row": "level"}, "row=level: unknown; there are: obstacle fraction, path length"),
    (c.RowsCurriculum, {"space": ONE_ROW}, "row=row: has a single row; give the axis bins"),
    (replay, {"train_on_new": True, "synchronous": True}, "train_on_new=true, synchronous=true: "),
    (no_edits, {"edits": 1}, "edits=1: the task must define edit"),
    (replay, {"new_levels": {"walls": [1]}}, r"new_levels.walls=\[1.0\]: must be among"),
    (replay, {"new_levels": {"path length": []}}, r"new_levels.path length=\[\]: "),
    (c.AdaptiveDifficulty, {"space": SPACE}, "pass_rates: none: this curriculum needs one of each"),
    (c.AdaptiveDifficulty, {"space": ONE_RATE}, "pass_rates: 1 missing: this curriculum needs one"),
    (c.CategoryBandit, {"space": ONE_RATE}, "features: have no texts: this curriculum needs a cat"),
    (partial(c.Mixed, TWO), {"shares": [1.0]}, r"shares=\[1.0\]: 2 curricula need as many"),
    (partial(c.Mixed, TWO), {"shares": [0.0, 0.0]}, "shares=.*, not all of them zero"),
    *(
        (schedule, {"until": until}, "3 stages need 2 ascending positive")
        for until in ([], [2], [3, 2], [2, 2], [0, 4])
    ),
    *((make, {"space": ONE}, SINGLE) for make in (c.LearningProgressCurriculum, Mixture)),
    (first_order, {"space": ONE}, SINGLE),
    (rounded, {"space": SEEDS, "rounded": False}, SINGLE),
    (rounded, {"space": ONE}, SINGLE),
    (partial(c.TransportCurriculum, MANY, torch.ones(5000)), {}, "5,000 bins: .* on more than 256"),
    *(
        (make, {"space": WIDE}, TOO_MANY)
        for make in (c.RowsCurriculum, c.BoundsCurriculum, c.BetaSampling)
    ),
    (
        c.LearningProgressCurriculum,
        {"space": WIDE},
        TOO_MANY,
    ),
    (partial(ParameterSpace, HUGE), {}, "parameters: .* combinations of their bins"),
    (
        partial(c.Filtered, c.Schedule([c.Mixed(TWO[:1], [1])], [])),
        {"scorer": GivenScores(torch.zeros(1, 1))},
        "filter each curriculum of a mixture by itself",
    ),
]


@pytest.mark.parametrize(("make", "options", "message"), REFUSED)
def test_what_is_out_of_bounds_is_named(
    make: Callable[..., Any], options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message) as refused:
        make(**options)
    assert "\n" not in str(refused.value)


def test_points_of_a_space_without_bins_are_taken_as_they_are() -> None:
    rounded(ONE, rounded=False)
    assert SEEDS.shares(SEEDS).tolist() == [1.0]


BLIND = Scripted(torch.rand(3), told="return")
ONLY_RETURNS = TensorDict({"return": torch.rand(1, 3)}, [1, 3])
GAINED: Any = TrainingStep(*[ONLY_RETURNS] * 5)
NO_SUCCESS: list[tuple[Callable[[], Any], str]] = [
    (lambda: c.Scorer("learnability", "exact")(BLIND, torch.tensor([0, 1]), Streams(0)), ""),
    (lambda: step(c.LearningProgressCurriculum(BLIND.space), BLIND, 0), "measure=return"),
    (lambda: log_success_gain(GAINED), r"rewards\.performance_gain"),
    (lambda: target_performance(ONLY_RETURNS, "log_success"), "measure=return"),
]


@pytest.mark.parametrize(("call", "way_out"), NO_SUCCESS)
def test_a_task_without_success_is_told_what_to_give(call: Any, way_out: str) -> None:
    with pytest.raises(NoSuccessError, match=f"this task tells no success.*{way_out}") as error:
        call()
    assert error.value.exit_code == 2
    step(c.LearningProgressCurriculum(BLIND.space, measure="return"), BLIND, 0)


CHECKED = """AdaptiveDifficulty AdaptiveMixture ArcLengthFilter BetaSampling BoundsCurriculum
CategoryBandit Filtered FirstOrderCurriculum FirstOrderProposer LearningProgressCurriculum Mixed
MixtureCurriculum Modelled ReplayCurriculum ReplayRule RowsCurriculum Schedule Scorer
SelectionCurriculum SelfPacedCurriculum TransportCurriculum"""


@pytest.mark.parametrize("kind", CHECKED.split())
def test_constructors_are_held_to_their_signatures(kind: str) -> None:
    """What that refuses is tested in ``test_arguments.py``."""
    with pytest.raises(ArgumentError, match=r"^sing: unknown; there are: "):
        getattr(c, kind)(sing=1)

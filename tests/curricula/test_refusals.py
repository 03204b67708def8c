"""Bounds stand in the signatures, which one validator holds; here is what each curriculum asks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch

import proposer_rl as prl
from proposer_rl.curricula import (
    AdaptiveDifficulty,
    AdaptiveMixture,
    ArcLengthFilter,
    BetaSampling,
    BoundsCurriculum,
    CategoryBandit,
    Curriculum,
    Filtered,
    FirstOrderCurriculum,
    FirstOrderProposer,
    LearningProgressCurriculum,
    Mixed,
    MixtureCurriculum,
    Modelled,
    ReplayCurriculum,
    ReplayRule,
    RowsCurriculum,
    SamplingCurriculum,
    Schedule,
    Scorer,
    SelectionCurriculum,
    SelfPacedCurriculum,
    TransportCurriculum,
)
from proposer_rl.meta.actions import Mixture
from proposer_rl.settings import ArgumentError
from proposer_rl.tasks.parameters import ParameterSpace, intervals
from tests.curricula.made import SETTINGS, SPACE, TARGET, problem_agent, replay
from tests.curricula.scripted import GivenScores

TWO: list[Curriculum] = [SamplingCurriculum(SPACE)] * 2
gaussians = partial(MixtureCurriculum, SPACE, refit=64, warmup=64)
bounds, rows = partial(BoundsCurriculum, SPACE), partial(RowsCurriculum, SPACE)
one_row = partial(RowsCurriculum, prl.Parameters({"row": (0.0, 1.0)}, bins=1))
ONE_RATE = prl.Items(2, pass_rates=[0.5, float("nan")])
no_edits = partial(ReplayCurriculum, SPACE, Scorer("positive_value_loss", "episodes"))

REFUSED: list[tuple[Callable[..., Any], dict[str, Any], str]] = [
    (gaussians, {"components": 65}, "components=65: must be at most refit=64, and that at most"),
    (gaussians, {"warmup": 63}, "components=10: must be at most refit=64, .* at most warmup=63"),
    (bounds, {"start": {"place": 0.0}}, "start.place: unknown; there are: obstacle fraction, path"),
    (bounds, {"lower": 0.6}, "lower=0.6: must be at most upper=0.5"),
    (rows, {"lower": 0.6}, "lower=0.6: must be at most upper=0.5"),
    (rows, {"row": "level"}, "row=level: unknown; there are: obstacle fraction, path length"),
    (one_row, {}, "row=row: has a single row; give it bins"),
    (replay, {"train_on_new": True, "synchronous": True}, "train_on_new=true, synchronous=true: "),
    (replay, {"co_learnability": 1.0, "renew": True}, r"co_learnability=1\.0, renew=true: "),
    (no_edits, {"edits": 1}, "edits=1: the task has no edit"),
    (replay, {"new_levels": {"walls": [1]}}, r"new_levels.walls=\[1.0\]: must be among"),
    (replay, {"new_levels": {"path length": []}}, r"new_levels.path length=\[\]: "),
    (partial(AdaptiveDifficulty, SPACE), {}, "pass_rates: none: this curriculum needs one of each"),
    (partial(AdaptiveDifficulty, ONE_RATE), {}, "pass_rates: 1 missing: this curriculum needs one"),
    (partial(CategoryBandit, ONE_RATE), {}, "features: have no texts: this curriculum needs a cat"),
    (partial(Mixed, TWO), {"shares": [1.0]}, r"shares=\[1.0\]: 2 curricula need as many"),
    (partial(Mixed, TWO), {"shares": [1.0, -1.0]}, "shares.1=-1.0: input should be greater"),
    (partial(Mixed, TWO), {"shares": [0.0, 0.0]}, "shares=.*, not all of them zero"),
    *(
        (partial(Schedule, [*TWO, TWO[0]]), {"until": until}, "3 stages need 2 ascending positive")
        for until in ([], [2], [3, 2], [2, 2], [0, 4])
    ),
]


@pytest.mark.parametrize(("make", "options", "message"), REFUSED)
def test_what_is_out_of_bounds_is_named(
    make: Callable[..., Any], options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ArgumentError, match=message) as refused:
        make(**options)
    assert "\n" not in str(refused.value)


CHECKED = [
    *(AdaptiveDifficulty, AdaptiveMixture, ArcLengthFilter, BetaSampling, BoundsCurriculum),
    *(CategoryBandit, Filtered, FirstOrderCurriculum, FirstOrderProposer, Mixed, Modelled),
    *(LearningProgressCurriculum, MixtureCurriculum, ReplayCurriculum, ReplayRule, Schedule),
    *(RowsCurriculum, Scorer, SelectionCurriculum, SelfPacedCurriculum, TransportCurriculum),
]


@pytest.mark.parametrize("kind", CHECKED)
def test_constructors_are_held_to_their_signatures(kind: Any) -> None:
    """What that refuses is tested in ``test_arguments.py``."""
    with pytest.raises(ArgumentError, match=r"^sing: unknown; there are: "):
        kind(sing=1)


def test_a_mixture_is_not_filtered() -> None:
    with pytest.raises(ValueError, match="filter the curricula of a mixture, each by itself"):
        Filtered(Schedule([Mixed(TWO[:1], [1])], []), GivenScores(torch.zeros(1, 1)))


def test_what_bins_cost_or_lack_is_told_first() -> None:
    one, many = (ParameterSpace({"x": intervals(0.0, 1.0, count)}) for count in (1, 5000))
    draws = partial(  # and PAIRED's generator, its twin
        FirstOrderProposer,
        target=TARGET,
        agent=problem_agent(),
        settings=SETTINGS,
        target_levels=3,
        step=1.0,
        measure="return",
    )
    seeds, rounded = ParameterSpace({}), partial(MixtureCurriculum, refit=64, warmup=64)
    makers: list[Callable[..., Any]] = [LearningProgressCurriculum, Mixture, draws]
    for make in (
        *(partial(maker, one) for maker in makers),
        partial(rounded, seeds, rounded=False),
    ):
        with pytest.raises(
            ValueError, match=r"^the space has a single bin, so there is nothing to"
        ):
            make()
    with pytest.raises(ArgumentError, match=r"rounded=true: .* its axes bins, or rounded=false"):
        rounded(one)
    rounded(one, rounded=False)
    assert seeds.shares(seeds).tolist() == [1.0]
    with pytest.raises(ArgumentError, match=r"5,000 bins: .* on more than 256"):
        TransportCurriculum(many, torch.ones(5000))
    wide = ParameterSpace({str(axis): intervals(0.0, 1.0, 8) for axis in range(9)})
    for maker in (RowsCurriculum, BoundsCurriculum, BetaSampling, LearningProgressCurriculum):
        with pytest.raises(ArgumentError, match="134,217,728 bins: at most 100,000,000"):
            maker(wide)
    with pytest.raises(ValueError, match=r"parameters: .* combinations of their bins"):
        ParameterSpace({str(axis): intervals(0.0, 1.0, 256) for axis in range(8)})

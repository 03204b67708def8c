"""Compares methods and decides which of two is better."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from itertools import combinations
from typing import NamedTuple

import numpy as np

from proposer_rl.report import statistics
from proposer_rl.report.runs import Run
from proposer_rl.report.statistics import Estimate, Interval
from proposer_rl.report.studies import Group, Study
from proposer_rl.runs.folder import is_rate
from proposer_rl.runs.records import level_text, words

ALIKE = 0.1  # of a rate: smaller differences are small, and smaller gains are no learning

TOO_FEW, UNDECIDED, NOT_LEARNT = "too few seeds", "no significant difference", "nothing learnt"


class Outcome(NamedTuple):
    """A number for each run of a group.

    Attributes:
        name: with its unit.
        value: of a run; NaN where it has none.
        sign: 1 where more is better, -1 where less is.
    """

    name: str
    value: Callable[[Run], float]
    sign: int = 1

    def known(self, group: Group) -> dict[int, float]:
        """Returns the outcome of each of a group's runs that has one, by the run's seed."""
        found = {run.seed: self.value(run) for run in group.runs}
        return {seed: value for seed, value in found.items() if not math.isnan(value)}

    def values(self, group: Group) -> list[float]:
        """Returns the known outcomes of a group's runs."""
        return list(self.known(group).values())

    def median(self, group: Group) -> Interval | None:
        """Returns the median of a group's outcomes with its interval; None without any."""
        values = self.values(group)
        return statistics.median_interval(values) if values else None


class Decision(NamedTuple):
    """The decision on which of two methods is better, by an outcome.

    Attributes:
        winner: its label; None where neither is said to be better.
        verdict: in a few words.
        p: corrected for the number of comparisons; NaN where nothing could be tested.
        reason: in words.
        seeds: about how many would decide it; None where it is decided or this is unknown.
        alone: p without correction.
        tests: the number of comparisons that p is corrected for.
        leader: label of the one with the higher mean; None if it has hardly learnt.
    """

    winner: str | None
    verdict: str
    p: float
    reason: str
    seeds: int | None = None
    alone: float = math.nan
    tests: int = 0
    leader: str | None = None

    def told(self, label: str) -> str:
        """Returns the decision for one of the two methods in words, with its p.

        The interval beside it is of one comparison. Where that excludes zero but the corrected test
        is not significant, the text has both p.
        """
        if math.isnan(self.p):
            return self.verdict if self.verdict == TOO_FEW else f"undecided: {self.reason}"
        if self.p > statistics.ERROR >= self.alone:
            return (
                f"undecided: p {p_text(self.p)} in {self.tests} tests, {p_text(self.alone)} alone"
            )
        kind = "undecided" if self.p > statistics.ERROR else self.kind(label)
        return f"{kind}, p {p_text(self.p)}"

    def kind(self, label: str) -> str:
        """Returns whether a method is better or worse, given that the test decides."""
        if self.leader is None:
            return NOT_LEARNT
        return "better" if self.leader == label else "worse"


def p_text(p: float) -> str:
    """Returns a p-value in two digits."""
    return "< 0.001" if p < 0.001 else f"{float(f'{p:.2g}'):g}"


def primary(study: Study) -> Outcome:
    """Returns the outcome that decides whether a method beats another.

    That is the mean of the headline along training. Every run has it, whether it reaches the
    threshold or not; it depends on the whole of training; and as a mean over many measurements it
    varies little.
    """
    name, horizon = study.headline, study.horizon
    value = partial(Run.mean_until, measurement=name, budget=horizon)
    return Outcome(f"{words(name)}, mean over {horizon} updates", value)


def waiting_outcome(study: Study) -> Outcome:
    """Returns the outcome "updates to the threshold", cut off at the horizon."""
    name, threshold, horizon = study.headline, study.threshold, study.horizon
    return Outcome(
        f"updates to {level_text(name, threshold)} {words(name)} (at most {horizon})",
        partial(Run.waited, measurement=name, threshold=threshold, horizon=horizon),
        -1,
    )


def at_the_end(study: Study, name: str) -> Outcome:
    """Returns the outcome "measurement at the horizon"."""
    value = partial(Run.at, measurement=name, updates=study.horizon)
    return Outcome(f"{words(name)} after {study.horizon} updates", value)


def outcomes(study: Study) -> list[Outcome]:
    """Returns the primary outcome, which decides, and then the secondary ones."""
    ends = [at_the_end(study, name) for name in study.measurements]
    return [primary(study), waiting_outcome(study), *ends]


def difference(outcome: Outcome, one: Group, other: Group) -> Estimate:
    """Returns the difference of two groups' mean outcomes.

    Runs of the same seed begin with the same weights and draw the same numbers: where both groups
    have the same seeds, they are compared in pairs.
    """
    return difference_between(outcome.known(one), outcome.known(other))


def difference_between(one: Mapping[int, float], other: Mapping[int, float]) -> Estimate:
    """Returns the difference of two groups' means, given the values of their runs by seed."""
    paired = list(one) == list(other)
    return statistics.difference_of([*one.values()], [*other.values()], paired)


def learnt(group: Group, name: str, updates: float) -> bool:
    """Returns whether a measurement grew significantly, and a rate by more than :data:`ALIKE`."""
    gains = np.array([run.at(name, updates) - run.metrics[name].iloc[0] for run in group.runs])
    known = gains[~np.isnan(gains)]
    if len(known) < statistics.FEWEST:
        return False
    found = statistics.mean_of(known)
    low = found.value if math.isnan(found.error) else found.interval(1 - 2 * statistics.ERROR).low
    return low > (ALIKE if is_rate(name) else 0)


def decisions(study: Study, outcome: Outcome | None = None) -> dict[tuple[str, str], Decision]:
    """Decides for every pair of groups which is better, by their labels in either order.

    The tests of all pairs that were asked for are corrected together, by Holm's method.

    Args:
        study: the groups.
        outcome: of which more is better; None for the primary one.
    """
    decided = _decided(study, combinations(study.asked, 2), outcome or primary(study))
    return decided | {(other, one): decision for (one, other), decision in decided.items()}


def against_baseline(study: Study) -> dict[str, Decision]:
    """Decides which methods are better or worse than the baseline by the primary outcome.

    Only these tests are corrected together, since only they were asked for.
    """
    baseline = study.baseline
    pairs = ((group, baseline) for group in study.asked if group.label != baseline.label)
    return {label: each for (label, _), each in _decided(study, pairs, primary(study)).items()}


def _decided(
    study: Study, pairs: Iterable[tuple[Group, Group]], outcome: Outcome
) -> dict[tuple[str, str], Decision]:
    pairs, known = [*pairs], {group.label: outcome.known(group) for group in study.compared}
    found = [difference_between(known[one.label], known[other.label]) for one, other in pairs]
    corrected = statistics.holm([one.p for one in found])
    count = sum(not math.isnan(p) for p in corrected)
    return {
        (one.label, other.label): _decide(study, (one, other), known, estimate, p, count)
        for (one, other), estimate, p in zip(pairs, found, corrected, strict=True)
    }


def _decide(
    study: Study,
    pair: tuple[Group, Group],
    known: Mapping[str, Mapping[int, float]],
    estimate: Estimate,
    p: float,
    count: int,
) -> Decision:
    values = [list(known[group.label].values()) for group in pair]
    runs = [len(own) for own in values]
    if min(runs) < statistics.FEWEST:
        text = f"{runs[0]} and {runs[1]} seeds, and it takes {statistics.FEWEST} of each"
        return Decision(None, TOO_FEW, p, text)
    if math.isnan(p):
        return Decision(None, UNDECIDED, p, "no spread between the runs")
    text = f"p = {p:.2g} after correction for {count} comparisons"
    winner = pair[0] if estimate.value > 0 else pair[1]
    leader = winner.label if learnt(winner, study.headline, study.horizon) else None
    tested = (estimate.p, count, leader)
    if p > statistics.ERROR:
        if runs[0] != runs[1]:
            estimate = statistics.balanced(*values)
        needed = statistics.seeds_needed(estimate, min(runs), statistics.ERROR / count)
        more = f", about {needed:,} seeds each would decide it" if needed else ""
        return Decision(None, UNDECIDED, p, text + more, needed, *tested)
    if leader is None:
        hardly = f"{text}, but {winner.label} hardly learnt"
        return Decision(None, NOT_LEARNT, p, hardly, None, *tested)
    return Decision(leader, f"{leader} is better", p, text, None, *tested)

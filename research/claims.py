"""What the paper claims and what we claim, each with the evidence for or against it in one line.

The paper's claims are those of its section on results. Verdict and text come from one decision.
What the runs cannot decide is undecided, never taken as refuted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import special, stats

from proposer_rl.report.comparisons import (
    ALIKE,
    TOO_FEW,
    Decision,
    decisions,
    difference,
    learnt,
    outcomes,
    primary,
)
from proposer_rl.report.runs import Run
from proposer_rl.report.statistics import ERROR, FEWEST, Estimate, holm, mean_of
from proposer_rl.report.studies import Group, Study
from proposer_rl.report.tables import write
from proposer_rl.runs.folder import is_rate
from proposer_rl.runs.records import Record, numbers, words
from research.ranking import TARGET, Needs, needs_of

Verdict = Literal["supported", "contradicted", "undecided", "too few seeds"]
Evidence = tuple[Verdict, str]

TITLE = (
    "All Life is Problem Creation: Learning to Generate Environments that Maximize Performance "
    "Gain (SEA workshop, NeurIPS 2025)"
)
# The paper's methods, by the labels of groups without an ablation.
BASELINE, GAIN, DIFFICULTY = "target", "perf_gain", "task_difficulty"
OURS, PROPOSER, LITERAL = "first_order_gain", "first_order_proposer", "perf_gain, paper_literal"
RANDOM, HAND = "domain_randomization", "hand_designed"
STARTED = 0.1  # success at which learning has begun: the end of a stall
SOON = 0.1  # of a run: what is taken as at once


# Axes of a space along which levels become harder, whatever else they have.
HARDER = {"obstacle fraction", "walls", "path length"}


def paper_claims(study: Study) -> list[tuple[str, Evidence | None]]:
    """The claims of the paper, and what the runs say; None where its methods are missing."""
    tests: list[tuple[str, Callable[[Study], Evidence | None]]] = [
        ("The baseline that trains on the target alone stalls at first.", _stall),
        ("Both Proposers learn almost at once.", _learn_at_once),
        ("Performance gain learns faster than the baseline.", _faster),
        ("Out of distribution the methods end up alike.", _alike),
        ("Performance gain beats task difficulty slightly, not significantly.", _slightly),
        ("Proposals start easy and grow harder.", _grow_harder),
        (
            "The maximum gain of the replicas stays positive while the mean falls below zero.",
            _gains,
        ),
    ]
    return [(claim, test(study)) for claim, test in tests]


def rules(study: Study) -> str:
    """How verdicts are reached, for a reader."""
    gain = f" (a gain of more than {ALIKE:.0%})" if is_rate(study.headline) else ""
    return (
        f"Whether one method beats another is decided by one outcome, {primary(study).name}, at 5 "
        "% after Holm's correction for all pairs of methods in this study; the other outcomes are "
        f"reported and decide nothing. Besides, something must have been learnt{gain}. Differences "
        "are first minus second, with 95 % intervals. Undecided: neither the claim nor its "
        f"contrary is excluded. It takes {FEWEST} seeds of each method. *Alike* and *level* are "
        f"bounds of {ALIKE}: that no difference is seen does not show that there is none."
    )


def _faster(study: Study) -> Evidence | None:
    groups = _present(study, GAIN, BASELINE)
    return _beats(study, *groups) if len(groups) == 2 else None


def _beats(study: Study, one: Group, other: Group) -> Evidence:
    """Does the first of two methods beat the second, and at what cost in frames?"""
    decision = decisions(study)[one.label, other.label]
    verdict: Verdict = "too few seeds" if decision.verdict == TOO_FEW else "undecided"
    if decision.winner:
        verdict = "supported" if decision.winner == one.label else "contradicted"
    text = "; ".join(
        f"{outcome.name}: {write(difference(outcome, one, other).interval())}"
        f"{f' ({decision.reason})' * (number == 0)}"
        for number, outcome in enumerate(outcomes(study)[:3])
    )
    costs = [
        np.mean([r.total_frames[-1] / max(r.updates, 1) for r in g.runs]) for g in (one, other)
    ]
    ratio = costs[0] / costs[1] if costs[1] else math.nan
    return verdict, f"{text}; frames: {ratio:.1f} times as many"


def _stall(study: Study) -> Evidence | None:
    groups = _present(study, BASELINE)
    if not groups or not is_rate(study.headline):
        return None
    soon, count, text = _started(study, groups[0])
    if count < FEWEST:
        return "too few seeds", text
    verdict = _either(majority(count - soon, count), majority(soon, count))
    if verdict == "supported" and not learnt(groups[0], study.headline, study.horizon):
        return "undecided", f"{text}; it is not shown to learn after that"
    return verdict, text


def _learn_at_once(study: Study) -> Evidence | None:
    groups = _present(study, GAIN, DIFFICULTY)
    if len(groups) < 2 or not is_rate(study.headline):
        return None
    found = [_started(study, group) for group in groups]
    text = "; ".join(text for *_, text in found)
    if min(count for _, count, _ in found) < FEWEST:
        return "too few seeds", text
    soon = [majority(soon, count) for soon, count, _ in found]
    late = holm([majority(count - soon, count) for soon, count, _ in found])
    verdict = _either(max(soon), min(late))
    if verdict == "contradicted" and not any(_started(study, one)[0] for one in study.compared):
        # Too soon for a Solver of this size, whatever it trains on: that says nothing of a method.
        return "undecided", f"{text}; nor does any run of any method here"
    return verdict, text


def _started(study: Study, group: Group) -> tuple[int, int, str]:
    """How many runs of a group learnt at once, of how many, and both in words."""
    first = max(run.metrics["updates"][:2].iloc[-1] for run in group.runs)
    limit = max(SOON * study.horizon, float(first))  # no run can be seen to be faster
    known = [run.reached(study.headline, STARTED) for run in group.runs]
    soon = sum(updates <= limit for updates in known)
    text = (
        f"{group.label} gets to {STARTED:.0%} within {limit:.0f} updates in {soon} of {len(known)} "
        "runs (tested against a half)"
    )
    reached = sorted(updates for updates in known if not math.isnan(updates))
    if reached:
        span = dict.fromkeys(f"{updates:.0f}" for updates in (reached[0], reached[-1]))
        text += f", in {len(reached)} after {' to '.join(span)}"
    return soon, len(known), text


def _alike(study: Study) -> Evidence | None:
    groups = _present(study, BASELINE, GAIN, DIFFICULTY)
    names = [name for name in study.measurements if is_rate(name) and name != study.headline]
    if len(groups) < 2 or not names:
        return None
    name = f"{words(names[0])} after {study.horizon} updates"
    (outcome,) = (outcome for outcome in outcomes(study) if outcome.name == name)
    pairs = list(combinations(groups, 2))
    found = [difference(outcome, *pair) for pair in pairs]
    text = "; ".join(
        f"{one.label} − {other.label}: {write(each.interval())}"
        for (one, other), each in zip(pairs, found, strict=True)
    )
    text = f"{name}: {text}; alike is taken as within ±{ALIKE}, by two one-sided tests at 5 %"
    if min(len(outcome.known(group)) for group in groups) < FEWEST:
        return "too few seeds", text
    if all(within(each, ALIKE) for each in found):
        if all(learnt(group, names[0], study.horizon) for group in groups):
            return "supported", text
        return "undecided", f"{text}; not all have learnt"
    known = [p for each in found if not math.isnan(p := beyond(each, ALIKE))]
    smallest = min(holm(known), default=math.nan)
    text += f"; the smallest p of a larger difference is {smallest:.2g} after correction"
    return _either(math.nan, smallest), text


def _slightly(study: Study) -> Evidence | None:
    groups = _present(study, GAIN, DIFFICULTY)
    if len(groups) < 2:
        return None
    verdict, text = _beats(study, *groups)
    if verdict == "too few seeds":
        return verdict, text
    if verdict != "undecided":
        return "contradicted", f"{text}; the difference is significant"
    found = difference(primary(study), *groups)
    if found.p <= ERROR:  # the more methods are compared, the less of it corrections leave
        return "undecided", f"{text}; significant without correction (p = {found.p:.2g})"
    slight = is_rate(study.headline) and found.value > 0 and within(found, ALIKE)
    if slight and all(learnt(group, study.headline, study.horizon) for group in groups):
        return "supported", f"{text}; it is shown to be within ±{ALIKE}"
    return "undecided", f"{text}; it is not shown to be small and positive either"


def _grow_harder(study: Study) -> Evidence | None:
    if not set(study.example.task.space) <= HARDER:
        return None
    parts: list[str] = []
    verdict: Verdict = "undecided"
    for group in study.compared:
        like = group.runs[0]
        known = [change for run in group.logs if (change := _change(run, like)) is not None]
        proposes = any("total_reward" in cycle for run in group.runs for cycle in run.cycles)
        if not proposes or not known:
            continue
        early, late = np.mean(known, 0)
        changes = [mean_of(values) for values in np.diff(known, axis=1)[:, 0].T]
        along = [
            f"{name} {a:.3g} to {b:.3g} (change {write(change.interval())})"
            for name, a, b, change in zip(like.task.space, early, late, changes, strict=True)
        ]
        parts.append(f"{group.label}: mean {', '.join(along)}")
        if group.label == GAIN:
            p = holm([change.p for change in changes])
            sure = {np.sign(c.value) for c, p in zip(changes, p, strict=True) if p <= ERROR}
            verdict = "supported" if sure == {1} else "contradicted" if sure == {-1} else verdict
            verdict = "too few seeds" if len(known) < FEWEST else verdict
    if not parts or study.group(GAIN) is None:
        return None
    return verdict, "; ".join(parts) + "; first against last quarter of the cycles"


def _change(run: Run, like: Run) -> NDArray[np.float64] | None:
    """Mean values along each axis in the first and the last quarter of a run, [2, axes]."""
    means = [found for cycle in run.cycles if (found := axis_means(like, cycle))]
    quarter = max(len(means) // 4, 1)
    if len(means) < 2:
        return None
    return np.array([np.mean(means[:quarter], 0), np.mean(means[-quarter:], 0)])


def _gains(study: Study) -> Evidence | None:
    group = study.group(GAIN)
    found = [
        [
            copies
            for cycle in run.cycles
            if (copies := numbers(cycle.get("return_gain"))) is not None
        ]
        for run in (group.logs if group else [])
    ]
    gains = [run for run in found if run]
    if not gains:
        return None
    positive = [copies.max() > 0 for run in gains for copies in run]
    late = [np.mean([copies.mean() for copies in run[-max(len(run) // 4, 1) :]]) for run in gains]
    interval, share = mean_of(late).interval(), float(np.mean(positive))
    text = (
        f"the maximum gain in return is positive in {sum(positive)} of {len(positive)} cycles; the "
        f"mean of the last quarter is {write(interval, 3)}"
    )
    if len(gains) < FEWEST:
        return "too few seeds", text
    if interval.low > 0 or share < 0.5:
        return "contradicted", text
    return ("supported" if share > 0.9 and interval.high < 0 else "undecided"), text


def within(found: Estimate, bound: float) -> bool:
    """Whether a value is shown to be between ``-bound`` and ``bound``.

    Two one-sided tests, each at 5 %: the interval of 90 % is inside (Schuirmann, Journal of
    Pharmacokinetics and Biopharmaceutics 15, 1987).
    """
    interval = found.interval(1 - 2 * ERROR)
    return -bound < interval.low and interval.high < bound


def beyond(found: Estimate, bound: float) -> float:
    """p-value of a value being farther from zero than ``bound``, one-sided."""
    return float(special.stdtr(found.freedom, (bound - abs(found.value)) / found.error))


def majority(count: int, of: int) -> float:
    """How surely a share is more than a half: the binomial test's p-value, one-sided and exact."""
    return float(stats.binomtest(count, of, 0.5, alternative="greater").pvalue)


def _either(p_for: float, p_against: float) -> Verdict:
    """The verdict of two one-sided tests, of the claim and of its contrary."""
    if p_for <= ERROR:
        return "supported"
    return "contradicted" if p_against <= ERROR else "undecided"


def _present(study: Study, *labels: str) -> list[Group]:
    found = map(study.group, labels)
    return [group for group in found if group is not None]


def own_claims(study: Study, needs: Needs) -> list[tuple[str, Evidence | None]]:
    """Our claims, and what the runs say of each; None where its methods are missing.

    Args:
        study: the runs.
        needs: what each method needs.
    """
    return [
        (
            "First-order gain beats domain randomization, the target alone and every target-free "
            "method.",
            _beats_all(study, needs),
        ),
        (
            "First-order gain is level with the hand-designed curriculum, or better.",
            _level_or_better(study),
        ),
        (
            "A Proposer that is rewarded for each problem by itself learns where the paper's "
            "literal one does not.",
            _learns_where_the_other_does_not(study),
        ),
    ]


def _beats_all(study: Study, needs: Needs) -> Evidence | None:
    one = study.group(OURS)
    free = [
        group
        for group in study.compared
        if group is not one and TARGET not in needs_of(group, needs, {TARGET})
    ]
    random, none = study.group(RANDOM), study.group(BASELINE)
    if one is None or random is None or none is None:
        return None
    others = [none, *free]
    found = decisions(study)
    pairs = [(other, found[one.label, other.label]) for other in others]
    text = "; ".join(_against(study, one, *pair) for pair in pairs)
    text = f"{primary(study).name}, difference to {text}; {_frames(one, others)}"
    if any(decision.winner not in (None, one.label) for _, decision in pairs):
        return "contradicted", text
    if all(decision.winner == one.label for _, decision in pairs):
        return "supported", text
    few = all(decision.verdict == TOO_FEW for _, decision in pairs)
    return ("too few seeds" if few else "undecided"), text


def _level_or_better(study: Study) -> Evidence | None:
    one, hand = study.group(OURS), study.group(HAND)
    if one is None or hand is None or not is_rate(study.headline):
        return None
    decision = decisions(study)[one.label, hand.label]
    low = difference(primary(study), one, hand).interval(1 - 2 * ERROR).low
    text = (
        f"{primary(study).name}, difference to {_against(study, one, hand, decision)}; level is "
        f"taken as no more than {ALIKE} below, by a one-sided test at 5 % (bound "
        f"{write(float(low), 3)}); {_frames(one, [hand])}"
    )
    if decision.verdict == TOO_FEW:
        return "too few seeds", text
    if decision.winner == hand.label:
        return "contradicted", text
    sure = low > -ALIKE and learnt(one, study.headline, study.horizon)
    return ("supported" if sure else "undecided"), text


def _learns_where_the_other_does_not(study: Study) -> Evidence | None:
    """Does it beat domain randomization, and is the other shown not to beat it?"""
    own, literal, random = (study.group(label) for label in (PROPOSER, LITERAL, RANDOM))
    if own is None or literal is None or random is None or not is_rate(study.headline):
        return None
    verdict, text = _beats(study, own, random)
    other, more = _beats(study, literal, random)
    text = f"{own.label} against {random.label}: {text}. {literal.label} against it: {more}"
    if "too few seeds" in (verdict, other):
        return "too few seeds", text
    high = difference(primary(study), literal, random).interval(1 - 2 * ERROR).high
    if other == "supported" or verdict == "contradicted":
        return "contradicted", text
    if verdict == "supported" and (other == "contradicted" or high < ALIKE):
        text += f"; the literal one is shown not to be better by {ALIKE} (one-sided, at 5 %)"
        return "supported", text
    return "undecided", text


def _against(study: Study, one: Group, other: Group, decision: Decision) -> str:
    found = difference(primary(study), one, other).interval()
    said = decision.verdict if decision.winner is None else f"p = {decision.p:.2g}"
    return f"{other.label} {write(found)} ({said})"


def _frames(one: Group, others: Sequence[Group]) -> str:
    own, *rest = (
        float(np.mean([r.total_frames[-1] for r in g.runs])) / 1e6 for g in (one, *others)
    )
    return f"cost: {write(own)} million frames, theirs {write(min(rest))} to {write(max(rest))}"


def axis_means(run: Run, cycle: Record) -> list[float] | None:
    """Mean value of a cycle's proposals along each axis; None without a histogram."""
    shares = run.shares(cycle)
    if shares is None:
        return None
    sides = range(shares.ndim)
    return [
        float(shares.sum(tuple(other for other in sides if other != side)) @ values)
        for side, values in zip(sides, run.task.space.values(), strict=True)
    ]

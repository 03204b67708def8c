"""The findings to be tested, each with the evidence for or against it in one line.

The paper's are those of its section on results; ours ask of every Proposer whether it beats what
needs none. A finding that the runs cannot decide is said to be undecided, never taken as refuted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import combinations, permutations
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from proposer_rl.report.outcomes import (
    Comparison,
    compare,
    outcomes,
    updates_needed,
    waiting_outcome,
)
from proposer_rl.report.proposals import axis_means
from proposer_rl.report.records import is_rate, level_text, numbers
from proposer_rl.report.runs import Run
from proposer_rl.report.statistics import mean_interval
from proposer_rl.report.studies import Group, Study
from proposer_rl.report.tables import Cell, Table, write

Verdict = Literal["supported", "contradicted", "undecided", "no data"]
Evidence = tuple[Verdict, str]

# The paper's methods, by the labels of groups without an ablation.
BASELINE, GAIN, DIFFICULTY = "target", "perf_gain", "task_difficulty"
STARTED = 0.1  # success at which learning has begun: the end of a stall
SOON, LATE = 0.1, 0.25  # of a run: what is taken as at once, and what as not at once


class Finding(NamedTuple):
    """A claim and what the runs say of it.

    Attributes:
        claim: in one sentence.
        source: who says so.
        verdict: what the evidence says.
        evidence: in one line, with its intervals.
    """

    claim: str
    source: str
    verdict: Verdict
    evidence: str


def findings(study: Study) -> list[Finding]:
    """All findings of the paper, then the questions about every Proposer of the study."""
    threshold = level_text(study.headline, study.threshold)
    tests: list[tuple[str, Callable[[Study], Evidence]]] = [
        ("The baseline that trains on the target alone stalls at first.", _stall),
        ("Both Proposers learn almost at once.", _learn_at_once),
        (f"Performance gain needs clearly fewer updates to {threshold} than the baseline.", _fewer),
        ("Out of distribution the methods end up alike.", _alike),
        ("Performance gain beats task difficulty slightly, not significantly.", _slightly),
        ("Proposals start easy and grow harder.", _grow_harder),
        ("The maximum gain of the copies stays positive while the mean falls below zero.", _gains),
    ]
    return [Finding(claim, "paper", *test(study)) for claim, test in tests] + _questions(study)


def finding_table(rows: Sequence[Finding]) -> Table:
    """Findings as a table."""
    note = (
        "Differences are first minus second, with 95 % intervals; fewer updates and higher "
        "measurements are better. Undecided: the interval includes no difference. Whether one "
        "method beats another is decided by the updates to the threshold; where these decide "
        "nothing, by the mean of the measurement, then by the measurement at the end."
    )
    named: list[dict[str, Cell]] = [
        {"finding": claim, "source": source, "verdict": verdict, "evidence": evidence}
        for claim, source, verdict, evidence in rows
    ]
    return Table("findings", "Findings", note, named)


def _stall(study: Study) -> Evidence:
    if not (baseline := _present(study, BASELINE)) or not is_rate(study.headline):
        return _missing(BASELINE)
    group, others = baseline[0], _present(study, GAIN, DIFFICULTY)
    found = [run.updates for run in group.waiting(study.headline, STARTED)]
    text = (
        f"{BASELINE} needs {write(updates_needed(study, group, STARTED), 0)} updates to "
        f"{STARTED:.0%} (runs from {min(found):.0f} to {max(found):.0f}; paper: about 150 of 750)"
    )
    if not others:
        return "undecided", f"{text}; no Proposer to compare with"
    rows = [compare(waiting_outcome(study, STARTED), group, other) for other in others]
    return _all(rows, worse=BASELINE), f"{text}; {_differences(rows)}"


def _learn_at_once(study: Study) -> Evidence:
    groups = _present(study, GAIN, DIFFICULTY)
    if len(groups) < 2 or not is_rate(study.headline):
        return _missing(GAIN, DIFFICULTY)
    horizon = study.horizon
    intervals = {group.label: updates_needed(study, group, STARTED) for group in groups}
    text = ", ".join(
        f"{label} {write(interval, 0)} ({interval.estimate / horizon:.0%} of the run)"
        for label, interval in intervals.items()
    )
    verdict: Verdict = "undecided"
    if all(interval.high <= SOON * horizon for interval in intervals.values()):
        verdict = "supported"
    elif any(interval.low > LATE * horizon for interval in intervals.values()):
        verdict = "contradicted"
    return verdict, (
        f"updates to {STARTED:.0%}: {text}; at once is taken as within {SOON:.0%} of "
        f"the run, not at once as after {LATE:.0%}"
    )


def _fewer(study: Study) -> Evidence:
    groups = _present(study, GAIN, BASELINE)
    if len(groups) < 2:
        return _missing(GAIN, BASELINE)
    row = compare(waiting_outcome(study, study.threshold), *groups)
    parts = []
    for group in groups:
        waiting = group.waiting(study.headline, study.threshold)
        needed = write(updates_needed(study, group, study.threshold), 0)
        reached = sum(run.reached for run in waiting)
        parts.append(f"{group.label} {needed} updates, reached by {reached} of {len(waiting)}")
    return _all([row], worse=BASELINE), f"{'; '.join(parts)}; {_differences([row])}"


def _alike(study: Study) -> Evidence:
    groups = _present(study, BASELINE, GAIN, DIFFICULTY)
    elsewhere = [
        outcome
        for name, outcome in zip(study.measurements, outcomes(study)[2:], strict=True)
        if is_rate(name) and name != study.headline
    ]
    if len(groups) < 2 or not elsewhere:
        return _missing(BASELINE, GAIN, DIFFICULTY)
    rows = [compare(elsewhere[0], a, b) for a, b in combinations(groups, 2)]
    verdict: Verdict = "contradicted" if any(row.better for row in rows) else "undecided"
    # Alike is more than not proven different: the intervals must be narrow as well.
    if all(max(abs(row.difference.low), abs(row.difference.high)) < 0.1 for row in rows):
        verdict = "supported"
    text = f"{elsewhere[0].name}: {_differences(rows)}"
    return verdict, f"{text}; alike is taken as all intervals within ±0.1"


def _slightly(study: Study) -> Evidence:
    groups = _present(study, GAIN, DIFFICULTY)
    if len(groups) < 2:
        return _missing(GAIN, DIFFICULTY)
    rows = [compare(outcome, *groups) for outcome in outcomes(study)[:3]]
    better = {row.better for row in rows}
    text = "; ".join(f"{row.outcome}: {_difference(row)}" for row in rows)
    if better != {None}:
        verdict: Verdict = "contradicted" if DIFFICULTY in better else "undecided"
        return verdict, f"{text}; a difference is significant here"
    return "undecided", f"{text}; none is significant, which fits the claim but does not prove it"


def _grow_harder(study: Study) -> Evidence:
    parts: list[str] = []
    verdict: Verdict = "undecided"
    for group in study.groups:
        like = group.runs[0]
        known = [change for run in group.logs if (change := _change(run, like)) is not None]
        if not group.proposes or not known:
            continue
        early, late = np.mean(known, 0)
        changes = [mean_interval(values) for values in np.diff(known, axis=1)[:, 0].T]
        along = [
            f"{name} {a:.3g} to {b:.3g} (change {write(change)})"
            for name, a, b, change in zip(like.task.space, early, late, changes, strict=True)
        ]
        parts.append(f"{group.label}: mean {', '.join(along)}")
        harder = any(change.low > 0 for change in changes)
        if group.label == GAIN and harder != any(change.high < 0 for change in changes):
            verdict = "supported" if harder else "contradicted"
    if not parts:
        return _missing(GAIN)
    return verdict, "; ".join(parts) + "; first against last quarter of the cycles"


def _change(run: Run, like: Run) -> NDArray[np.float64] | None:
    """Mean values along each axis in the first and the last quarter of a run, [2, axes]."""
    means = [found for cycle in run.cycles if (found := axis_means(like, cycle))]
    quarter = max(len(means) // 4, 1)
    if len(means) < 2:
        return None
    return np.array([np.mean(means[:quarter], 0), np.mean(means[-quarter:], 0)])


def _gains(study: Study) -> Evidence:
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
        return _missing(GAIN)
    positive = [copies.max() > 0 for run in gains for copies in run]
    late = [np.mean([copies.mean() for copies in run[-max(len(run) // 4, 1) :]]) for run in gains]
    interval, share = mean_interval(late), float(np.mean(positive))
    text = (
        f"the maximum gain in return is positive in {sum(positive)} of {len(positive)} cycles; the "
        f"mean of the last quarter is {write(interval, 3)}"
    )
    if interval.low > 0 or share < 0.5:
        return "contradicted", text
    return ("supported" if share > 0.9 and interval.high < 0 else "undecided"), text


def _questions(study: Study) -> list[Finding]:
    """Of each Proposer: does it beat the others, and at what cost in frames?"""
    found = []
    for one, other in permutations(study.compared, 2):
        if not one.proposes or other.proposes:
            continue
        rows = [compare(outcome, one, other) for outcome in outcomes(study)[:3]]
        # By the sample efficiency; where that decides nothing, by what was measured.
        better = next((row.better for row in rows if row.better), None)
        verdict: Verdict = "undecided"
        if better:
            verdict = "supported" if better == one.label else "contradicted"
        costs = [
            np.mean([r.total_frames[-1] / max(r.updates, 1) for r in g.runs]) for g in (one, other)
        ]
        text = "; ".join(f"{row.outcome}: {_difference(row)}" for row in rows)
        ratio = costs[0] / costs[1] if costs[1] else math.nan
        text += f"; frames: {ratio:.1f} times as many"
        found.append(Finding(f"{one.label} beats {other.label}.", "ours", verdict, text))
    return found


def _all(rows: Sequence[Comparison], worse: str) -> Verdict:
    """Whether one group is worse than all others."""
    if any(row.better == worse for row in rows):
        return "contradicted"
    return "supported" if all(row.better for row in rows) else "undecided"


def _differences(rows: Sequence[Comparison]) -> str:
    return "; ".join(f"{row.one} − {row.other}: {_difference(row)}" for row in rows)


def _difference(row: Comparison) -> str:
    text = write(row.difference)
    if row.difference.low == row.difference.high == 0:
        return f"{text} (no run of either reached it, or all alike)"
    return f"{text} ({row.seeds:,} seeds each would be needed)" if row.seeds else text


def _present(study: Study, *labels: str) -> list[Group]:
    return [group for label in labels for group in study.compared if group.label == label]


def _missing(*labels: str) -> Evidence:
    return "no data", f"needs full runs of {' and '.join(labels)}, each in one variant"

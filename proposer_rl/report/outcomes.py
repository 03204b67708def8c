"""Tables of methods and pairs, and the sentences that summarise them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from proposer_rl.report.comparisons import (
    NOT_LEARNT,
    TOO_FEW,
    Decision,
    against_baseline,
    decisions,
    difference,
    difference_between,
    outcomes,
    primary,
    waiting_outcome,
)
from proposer_rl.report.runs import Run
from proposer_rl.report.statistics import FEWEST, INTERVALS, Interval
from proposer_rl.report.studies import Group, Study
from proposer_rl.report.tables import Cell, Table, write
from proposer_rl.runs.records import level_text, words

MILLION = 1e6
LISTED = 6  # methods that a sentence names


def comparison_table(study: Study) -> Table:
    """Returns a table of all pairs of groups by every outcome."""
    decided = decisions(study)
    rows: list[dict[str, Cell]] = []
    for number, outcome in enumerate(outcomes(study)):
        known = {group.label: outcome.known(group) for group in study.compared}
        for one, other in combinations(study.asked, 2):
            runs = [known[each.label] for each in (one, other)]
            if not all(runs):
                continue
            decision = decided[one.label, other.label] if number == 0 else None
            rows.append(
                {
                    "outcome": outcome.name,
                    "first": one.label,
                    "second": other.label,
                    "difference": difference_between(*runs).interval(),
                    "verdict": decision and decision.verdict,
                    "decision": decision and decision.told(one.label),
                    "p (Holm)": decision and decision.p,
                    "seeds needed": decision and decision.seeds,
                }
            )
    note = (
        f"Only the primary outcome, {primary(study).name}, has verdicts; their p-values are "
        "corrected for the number of pairs (Holm). The difference is the mean of the first method "
        "minus that of the second, with an uncorrected 95 % interval: Student's over pairs of runs "
        "where both have the same seeds, else Welch's. Seeds needed is about how many each method "
        "needs for a power of 80 %, if the true difference is the one seen. With fewer than "
        f"{FEWEST} seeds there is no interval and no verdict."
    )
    aside = ["verdict", "p (Holm)"]
    return Table("comparisons", "Pairwise comparisons", note, rows, aside)


class Row(NamedTuple):
    """A method against the baseline, as in the first table of a report.

    Attributes:
        label: of the method.
        difference: of the means over seeds, method minus baseline, with its interval.
        decision: against the baseline; None for the baseline itself.
        asked: whether the decision is among those that are corrected together.
        says: the difference and its cost in words, without the decision.
        reached: updates to the threshold; over several tasks the number of those that reach it.
        frames, seconds: as multiples of the baseline's.
        worst: over several tasks the lowest difference and its task.
    """

    label: str
    difference: Interval
    decision: Decision | None
    asked: bool
    says: str
    reached: str
    frames: float
    seconds: float
    worst: str = ""

    @property
    def verdict(self) -> str:
        """The verdict with its p; a dash where nothing was asked."""
        told = self.decision and self.asked and self.decision.told(self.label)
        return told or "–"

    @property
    def sentence(self) -> str:
        """The row as a sentence."""
        return f"{self.says}, {self.verdict}." if self.asked else f"{self.says}."


def first_rows(study: Study) -> list[Row]:
    """Returns all methods against the baseline, the highest mean over seeds first."""
    outcome, baseline = primary(study), study.baseline
    every = against_baseline(replace(study, planned=(), chosen=baseline.label))
    found = every | against_baseline(study)
    asked = {group.label for group in study.asked}
    rows = []
    for group in study.compared:
        between = difference(outcome, group, baseline).interval()
        costs = factors(group, baseline)
        says = f"{_reaching(study, group)} {cost(*costs)}; {outcome.name}: {signed(between)}"
        rows.append(
            Row(
                group.label,
                between,
                found.get(group.label),
                group.label in asked,
                says,
                " ".join(threshold_reached(study, group)[1:]),
                *costs,
            )
        )
    return sorted(rows, key=lambda row: -row.difference.estimate)


def factors(group: Group, baseline: Group) -> tuple[float, float]:
    """Returns a method's frames and seconds as multiples of the baseline's."""
    found = []
    for spent in (lambda run: run.total_frames[-1], lambda run: run.own_seconds[-1]):
        own, other = (np.mean([*map(spent, each.runs)]) for each in (group, baseline))
        found.append(float(own / other) if other > 0 else math.nan)
    return found[0], found[1]


def signed(difference: Interval) -> str:
    """Returns a difference with its sign."""
    return f"{'+' if difference.estimate > 0 else ''}{write(difference)}"


def cost(frames: float, seconds: float) -> str:
    """Returns a method's cost in words, as multiples of the baseline's."""
    return f"{times(frames)}× the frames and {times(seconds)}× the seconds"


def times(factor: float) -> str:
    """Returns a factor in two digits."""
    return "–" if math.isnan(factor) else f"{float(f'{factor:.2g}'):,g}"


def threshold_reached(study: Study, group: Group) -> tuple[bool, str, str]:
    """Returns whether most runs got to the threshold, the median of their updates, how many did."""
    got = sum(run.reached(study.headline, study.threshold) >= 0 for run in group.runs)
    most, median = 2 * got > len(group.runs), waiting_outcome(study).median(group)
    text = f"{median.estimate:g}" if most and median else f"> {study.horizon}"
    return most, text, "" if got in (0, len(group.runs)) else f"({got} of {len(group.runs)})"


def _reaching(study: Study, group: Group) -> str:
    """Returns a clause on the updates that a method and the baseline take to the threshold."""
    (own, *first), (other, *second) = (
        threshold_reached(study, each) for each in (group, study.baseline)
    )
    goal = f"{level_text(study.headline, study.threshold)} {words(study.headline)}"
    name, baseline, within = group.label, study.baseline.label, f"within {study.horizon} updates"
    takes = f"{baseline} takes {' '.join(second)}".strip()
    if not own and not other:
        return f"Neither {name} nor {baseline} reaches {goal} {within}, {name} at"
    if not own:
        return f"{name} does not reach {goal} {within}, where {takes}, at"
    start = f"{name} reaches {goal} after {first[0]} updates {first[1]}".strip()
    missed = f"{start}, which {baseline} does not within {study.horizon}, at"
    return f"{start} where {takes}, at" if other else missed


def first_table(
    rows: Sequence[Row], baseline: str, shown: str, note: str, name: str = "baseline"
) -> Table:
    """Returns the rows as a table, whose column on the threshold is titled ``shown``."""
    cells: list[dict[str, Cell]] = [
        {
            "method": row.label if row.decision else f"{row.label} (baseline)",
            "difference": row.difference if row.decision else None,
            "verdict": row.verdict,
            "p": row.decision and row.decision.alone,
            "p (Holm)": row.decision.p if row.decision and row.asked else None,
            **({"worst task": row.worst} if row.worst else {}),
            shown: row.reached,
            "frames (×)": times(row.frames),
            "seconds (×)": times(row.seconds),
        }
        for row in rows
    ]
    return Table(name, f"Against {baseline}", note, cells, ["p", "p (Holm)"])


def about_rows(study: Study) -> str:
    """Explains the columns of the first table."""
    return (
        f"The difference is that in {primary(study).name}: the method's mean over seeds minus that "
        f"of {study.baseline.label}, with an uncorrected 95 % interval; methods are sorted by it. "
        f"p is corrected for the number of comparisons with the baseline, {len(study.asked) - 1} "
        "(Holm). Updates are the median over seeds, with the number of runs that reached the "
        "threshold if not all did. × is a multiple of what the baseline spent, including frames of "
        "the curriculum."
    )


def group_table(study: Study) -> Table:
    """Returns a table with a row for each group."""
    headline, horizon, threshold = study.headline, study.horizon, study.threshold
    first, waiting, *ends = outcomes(study)
    shown = [waiting, first, *ends]
    rows: list[dict[str, Cell]] = []
    for group in study.groups:
        whole = study.group(group.label) or replace(group, runs=())
        runs, begun = whole.runs, len(group.runs)
        reached = sum(run.reached(headline, threshold) >= 0 for run in runs)
        row: dict[str, Cell] = {
            "method": group.label,
            "seeds": begun if len(runs) == begun else f"{len(runs)} of {begun}",
            f"reached {level_text(headline, threshold)}": f"{reached} of {len(runs)}",
            **{outcome.name: outcome.median(whole) for outcome in shown},
        }
        cost: dict[str, Callable[[Run], float]] = {
            "frames (M)": lambda run: run.last("frames") / MILLION,
            "with the curriculum's (M)": lambda run: run.total_frames[-1] / MILLION,
            "evaluations": lambda run: run.last("evaluations"),
            "seconds per run": lambda run: run.own_seconds[-1],
        }
        row |= {
            name: float(np.mean([spent(run) for run in runs or group.runs]))
            for name, spent in cost.items()
        }
        rows.append(row)
    note = (
        f"Updates to the threshold are of runs of full length and cut off at {horizon}; they are "
        "as exact as measurements are frequent. Frames are the Solver's own, then with those that "
        "the curriculum spent. Evaluations are those of levels that the curriculum asked for. "
        f"{INTERVALS}"
    )
    return Table("methods", "Methods", note, rows)


def answer(study: Study) -> list[str]:
    """Summarises a study in two or three sentences: one method against the baseline, then the rest.

    The method is the first planned one, or the one with the highest mean.
    """
    outcome, baseline, rows = primary(study), study.baseline, first_rows(study)
    ranked = [row for row in rows if row.asked]
    best = ranked[0].label
    mean = write(float(np.mean(outcome.values(study.group(best) or baseline))))
    if len(ranked) == 1:
        alone = "here" if len(study.groups) == 1 else f"with runs of {study.horizon} updates"
        return [
            f"{best} is the only method {alone} ({outcome.name}: {mean}, mean over seeds).",
            "Nothing is compared, so this page does not show whether that is good.",
        ]
    others = [row for row in ranked if row.decision]
    first = next(
        (row for label in study.planned for row in others if row.label == label), others[0]
    )
    found = {row.label: row.decision for row in others if row.decision}
    sentences = [first.sentence, _against(baseline, found)]
    if len(others) > 1:
        pairs = decisions(study)
        rest = {row.label: pairs[best, row.label] for row in ranked if row.label != best}
        sentences.append(
            f"Of {len(ranked)} methods, {best} has the highest mean over seeds ({mean}); "
            f"{_shown(best, rest)}."
        )
    return sentences


def meaning(group: Group) -> str:
    """Describes a method in a line, as its runs recorded it."""
    about = group.runs[0].facts.get("about", {})
    text = about.get("method") or "Its runs do not say what it does."
    text += f" Changed here: {about['ablation']}" if about.get("ablation") else ""
    return f"{text} ({group.setting})" if group.setting else text


def _shown(best: str, found: Mapping[str, Decision]) -> str:
    """Returns a clause on how many other methods the best one beats significantly."""
    beaten = [decision.winner == best for decision in found.values()]
    if all(decision.verdict == TOO_FEW for decision in found.values()):
        return f"but it takes {FEWEST} seeds of each to decide whether that is more than chance"
    if all(beaten):
        return f"it is significantly better than {'all others' if len(found) > 1 else 'the other'}"
    if any(decision.verdict == NOT_LEARNT for decision in found.values()):
        return "but it is not shown to have learnt"
    if not any(beaten):
        return "but there is no significant difference to any of the others"
    left = [label for label, decision in found.items() if decision.winner != best]
    return (
        f"it is significantly better than {sum(beaten)} of the {len(found)} others, with no "
        f"significant difference to {_listed(left)}"
    )


def _against(baseline: Group, found: Mapping[str, Decision]) -> str:
    """Returns a sentence on how the other methods compare to the baseline."""
    if all(decision.verdict == TOO_FEW for decision in found.values()):
        few = f"Too few seeds for a comparison with the baseline, {baseline.label}"
        return f"{few}: it takes {FEWEST} of each."
    better = [label for label, decision in found.items() if decision.winner == label]
    worse = [label for label, decision in found.items() if decision.winner == baseline.label]
    unlearnt = sum(decision.verdict == NOT_LEARNT for decision in found.values())
    rest = len(found) - len(better) - len(worse) - unlearnt
    first = f"{_listed(better) or 'No method'} {_is(better)}"
    parts = [f"{first} significantly better than the baseline, {baseline.label}"]
    parts += [f"{_listed(worse)} {_is(worse)} significantly worse"] if worse else []
    parts += [f"for {unlearnt} the better one is not shown to have learnt"] if unlearnt else []
    parts += [f"no significant difference for {rest}"] if rest else []
    return f"{'; '.join(parts)}."


def _listed(labels: Sequence[str]) -> str:
    if len(labels) > LISTED:
        return f"{len(labels)} methods"
    return " and ".join(filter(None, [", ".join(labels[:-1]), *labels[-1:]]))


def _is(labels: Sequence[str]) -> str:
    return "are" if len(labels) > 1 else "is"

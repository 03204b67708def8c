"""The results: tables of groups, pairs and runs, and the two sentences that a reader needs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from proposer_rl.report.comparisons import (
    NOT_LEARNT,
    TOO_FEW,
    Decision,
    at_the_end,
    decisions,
    difference,
    difference_between,
    outcomes,
    primary,
)
from proposer_rl.report.runs import Run
from proposer_rl.report.statistics import (
    FEWEST,
    INTERVALS,
    probability_of_improvement,
)
from proposer_rl.report.studies import Group, Study
from proposer_rl.report.tables import Cell, Table, write
from proposer_rl.runs.records import level_text, words

MILLION = 1e6
# What methods and ablations do, by ``method`` or ``ablation`` and name.
Meanings = Mapping[str, Mapping[str, str]]
LISTED = 6  # methods that a sentence names


def comparison_table(study: Study) -> Table:
    """Returns a table of all pairs of groups by every outcome."""
    decided = decisions(study)
    rows: list[dict[str, Cell]] = []
    for number, outcome in enumerate(outcomes(study)):
        known = {group.label: outcome.known(group) for group in study.compared}
        for one, other in combinations(study.compared, 2):
            runs = [known[each.label] for each in (one, other)]
            if not all(runs):
                continue
            values = [outcome.sign * np.array([*each.values()]) for each in runs]
            decision = decided[one.label, other.label] if number == 0 else None
            rows.append(
                {
                    "outcome": outcome.name,
                    "first": one.label,
                    "second": other.label,
                    "difference": difference_between(*runs).interval(),
                    "verdict": decision and decision.verdict,
                    "p (Holm)": decision and decision.p,
                    "P(first better)": probability_of_improvement(*values),
                    "seeds needed": decision and decision.seeds,
                }
            )
    note = (
        f"Only the primary outcome, {primary(study).name}, has verdicts; their p-values are "
        "corrected together for the number of pairs (Holm). Difference of means: first minus "
        "second, with a 95 % interval, not corrected: Student's over pairs of runs where both have "
        "the same seeds, else Welch's. P(first better): over all pairs of runs, ties count half; "
        "with Clopper's and Pearson's interval. Seeds needed: per method, about, for a power of "
        "80 % if the true difference is the one seen. With fewer than "
        f"{FEWEST} seeds no interval and no verdict."
    )
    return Table("comparisons", "Pairwise comparisons", note, rows)


def against_baseline(study: Study) -> Table:
    """Returns a table of every group against the baseline, by the primary outcome."""
    outcome, baseline, decided = primary(study), study.baseline, decisions(study)
    rows: list[dict[str, Cell]] = []
    for group in study.compared:
        if group.label != baseline.label:
            decision = decided[baseline.label, group.label]
            rows.append(
                {
                    "method": group.label,
                    "difference": difference(outcome, group, baseline).interval(),
                    "verdict": decision.verdict,
                    "p (Holm)": decision.p,
                }
            )
    note = (
        f"{outcome.name}: difference of means, method minus {baseline.label}, with a 95 % "
        "interval, not corrected; "
        "p-values are corrected for all pairs of methods (Holm)."
    )
    return Table("baseline", f"Against {baseline.label}", note, rows)


def group_table(study: Study) -> Table:
    """Returns a table with a row for each group."""
    headline, horizon, threshold = study.headline, study.horizon, study.threshold
    first, waiting, *ends = outcomes(study)
    shown, baseline = [waiting, first, *ends], study.baseline
    worst, tenth = f"{headline}_worst10", f"{words(headline)}, worst 10 %"
    rows: list[dict[str, Cell]] = []
    for group in study.groups:
        whole = study.group(group.label) or replace(group, runs=())
        runs, begun = whole.runs, len(group.runs)
        reached = sum(run.reached(headline, threshold) >= 0 for run in runs)
        both = [first.values(group), first.values(baseline)]
        other = group.label != baseline.label and all(both)
        row: dict[str, Cell] = {
            "method": group.label,
            "seeds": begun if len(runs) == begun else f"{len(runs)} of {begun}",
            f"reached {level_text(headline, threshold)}": f"{reached} of {len(runs)}",
            **{outcome.name: outcome.median(whole) for outcome in shown},
            f"P(better than {baseline.label})": probability_of_improvement(*both)
            if other
            else None,
        }
        if any(worst in run.metrics for run in study.runs):
            row[tenth] = at_the_end(study, worst).median(whole)
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
        f"Updates: min(updates, {horizon}) of the runs of full length; measured every "
        "few updates, so never exact. Frames: the Solver's own, and with all that the curriculum "
        "spent. Evaluations: of levels, asked for by the curriculum. P(better): that a run of the "
        f"method has the higher {first.name}. {INTERVALS}"
    )
    return Table("methods", "Methods", note, rows, [tenth])


def run_table(study: Study) -> Table:
    """Returns a table with a row for each run."""
    rows: list[dict[str, Cell]] = []
    for group in study.groups:
        for run in group.runs:
            reached = run.reached(study.headline, study.threshold)
            censored = math.isnan(reached)
            rows.append(
                {
                    "method": group.label,
                    "seed": str(run.seed),
                    "folder": run.folder.name,
                    "state": "finished" if run.finished else "unfinished",
                    "updates": run.updates,
                    f"updates to {level_text(study.headline, study.threshold)}": (
                        None if censored else int(reached)
                    ),
                    "threshold": f"censored at {run.updates}" if censored else "reached",
                    **{f"last {words(name)}": run.last(name) for name in study.measurements},
                    "frames": int(run.last("frames")),
                    "the curriculum's frames": int(run.last("curriculum_frames")),
                    "evaluations": int(run.last("evaluations")),
                    "seconds": float(run.own_seconds[-1]),
                }
            )
    return Table("runs", "Runs", "Measurements are the run's last.", rows)


def answer(study: Study) -> tuple[str, str]:
    """Returns two sentences: the best method with its test, and the others against the baseline."""
    outcome, baseline = primary(study), study.baseline
    ranked = sorted(study.compared, key=lambda group: -np.mean(outcome.values(group)))
    best, *others = ranked
    median = write(outcome.median(best))
    if not others:
        alone = "here" if len(study.groups) == 1 else f"with runs of {study.horizon} updates"
        return (
            f"{best.label} is the only method {alone} ({outcome.name}: {median}, median over "
            "seeds).",
            "Nothing is compared, so this page does not show whether that is good.",
        )
    found = decisions(study)
    # By the mean, as in the tests: by the median another could be significantly better.
    first = (
        f"Of {len(ranked)} methods, {best.label} has the highest {outcome.name} and over seeds "
        f"(median over seeds: {median}); "
        f"{_shown(best, {other.label: found[best.label, other.label] for other in others})}."
    )
    rest = [group.label for group in ranked if group is not baseline]
    return first, _against(baseline, {label: found[baseline.label, label] for label in rest})


def meaning(group: Group, meanings: Meanings) -> str:
    """Returns what a method does, in a line: as its runs recorded it, or else as given."""
    run = group.runs[0]
    about = run.facts.get("about", {})
    said = [
        about.get(kind) or meanings.get(kind, {}).get(name, "")
        for kind, name in (("method", run.method), ("ablation", run.ablation))
    ]
    text = said[0] or "Its runs do not say what it does."
    text += f" Changed here: {said[1]}" if said[1] else ""
    return f"{text} ({group.setting})" if group.setting else text


def _shown(best: Group, found: Mapping[str, Decision]) -> str:
    """Returns a clause on how many other methods the best one beats significantly."""
    beaten = [decision.winner == best.label for decision in found.values()]
    if all(decision.verdict == TOO_FEW for decision in found.values()):
        return f"but it takes {FEWEST} seeds of each to decide whether that is more than chance"
    if all(beaten):
        return f"it is significantly better than {'all others' if len(found) > 1 else 'the other'}"
    if any(decision.verdict == NOT_LEARNT for decision in found.values()):
        return "but it is not shown to have learnt"
    if not any(beaten):
        return "but there is no significant difference to any of the others"
    left = [label for label, decision in found.items() if decision.winner != best.label]
    return (
        f"it is significantly better than {sum(beaten)} of the {len(found)} others, with no "
        f"significant difference to {_listed(left)}"
    )


def _against(baseline: Group, found: Mapping[str, Decision]) -> str:
    """Returns a sentence on how the other methods compare to the baseline."""
    if all(decision.verdict == TOO_FEW for decision in found.values()):
        return f"Too few seeds for a comparison with the baseline, {baseline.label}."
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

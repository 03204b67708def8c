"""Which curriculum to use, by what is available and what is scarce."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from proposer_rl.report.comparisons import (
    Decision,
    Outcome,
    decisions,
    learnt,
    primary,
)
from proposer_rl.report.measures import COSTS
from proposer_rl.report.runs import Run
from proposer_rl.report.statistics import FEWEST, INTERVALS
from proposer_rl.report.studies import Group, Study
from proposer_rl.report.tables import Cell, Table, write
from proposer_rl.runs.records import words

# What methods need, as their files say.
TARGET, EXACT, GRADIENTS = "a target", "exact evaluation", "its gradients"
Needs = Mapping[str, Collection[str]]  # by method

SITUATIONS: Mapping[str, Collection[str]] = {
    "a known target, exact evaluation": {TARGET, EXACT, GRADIENTS},
    "a known target, episodes alone": {TARGET},
    "no target, exact evaluation": {EXACT, GRADIENTS},
    "no target, episodes alone": (),
}
STEADY = 1.5  # how many times one run of a method may cost what another does
FRAMES, SECONDS = COSTS
UNITS = {FRAMES: "million frames, the curriculum's too", SECONDS: "seconds"}


class Choice(NamedTuple):
    """The best of the methods that one can use.

    Attributes:
        best: has the greatest mean.
        value: its median over seeds, with the interval.
        level: labels of those to which there is no significant difference, from the best on.
        others: how many it was compared with.
        doubt: why nothing is chosen, in words; empty where something is.
    """

    best: Group
    value: str
    level: Sequence[str]
    others: int
    doubt: str

    def text(self) -> str:
        """As in ``ncc 0.53 [0.51, 0.55], better than all others (5)``."""
        best = f"{self.best.label} {self.value}"
        if self.doubt:
            return f"{best}, but {self.doubt}"
        if not self.others:
            return f"{best}, the only one"
        if self.level:
            return f"{best}, no significant difference to {', '.join(self.level)}"
        return f"{best}, better than all others ({self.others})"


def budgets(study: Study) -> Mapping[str, Outcome]:
    """What methods are ranked by, by what is scarce: the headline's mean over a budget of it.

    Of updates it is the primary outcome. Of what else training costs the budget is what the run
    that cost least spent on all of its updates, so that every method has spent it.
    """
    name, whole = study.headline, [run for group in study.compared for run in group.runs]
    found = {"updates": primary(study)}
    for axis, cost in COSTS.items():
        budget = min(float(cost(run)[-1]) for run in whole)
        value = partial(Run.mean_until, measurement=name, budget=budget, cost=cost)
        text = f"{float(f'{budget:.2g}'):,g}"  # 370, where .2g alone says 3.7e+02
        found[axis] = Outcome(f"{words(name)}, mean over {text} {UNITS[axis]}", value)
    return found


def spread(study: Study, scarce: str) -> float:
    """How many times what one run of a method cost another of it did, of the method worst off.

    Seconds are also those of whatever else the machine did; frames are not.
    """
    if scarce not in COSTS:
        return 1.0
    spent = [[float(COSTS[scarce](run)[-1]) for run in group.runs] for group in study.compared]
    return max((max(each) / min(each) for each in spent if min(each) > 0), default=1.0)


def needs_of(group: Group, needs: Needs, unknown: Collection[str] = ()) -> set[str]:
    """What a group's method needs: as its runs recorded it, or else as the caller knows it.

    A variant may ask for evaluations where its method does not, or for none where it does: what
    its runs spent decides.

    Args:
        group: of the method.
        needs: for runs that recorded none.
        unknown: of a method of which nobody knows.
    """
    run = group.runs[0]
    said = run.facts.get("about", {}).get("needs")
    found = set(needs.get(run.method, unknown) if said is None else filter(None, said.split(", ")))
    # Where performance is played, an evaluation is episodes.
    exact = [each for each in group.runs if each.task.exact is not False]
    asked = any(each.last("evaluations") > 0 for each in exact)
    return found | {EXACT} if asked else found - {EXACT, GRADIENTS}


def choose(
    study: Study,
    usable: Sequence[Group],
    outcome: Outcome,
    found: Sequence[Mapping[tuple[str, str], Decision]],
    unsteady: float = 1.0,
) -> Choice | None:
    """The best of some methods by an outcome; None where none has a value.

    It is looked for among those with enough seeds, if there are any.

    Args:
        study: the runs.
        usable: the methods.
        outcome: of which more is better.
        found: what was decided by it of every pair, once or by several timings: a
            difference counts where all find it.
        unsteady: the :func:`spread` of what is scarce.
    """
    means = {group.label: outcome.values(group) for group in usable}
    ranked = sorted(
        (group for group in usable if means[group.label]),
        key=lambda group: -np.mean(means[group.label]),
    )
    if not ranked:
        return None
    best, *others = [group for group in ranked if len(means[group.label]) >= FEWEST] or ranked
    level = [
        other.label
        for other in others
        if any(each[best.label, other.label].winner != best.label for each in found)
    ]
    doubt = ""
    if len(means[best.label]) < FEWEST:
        doubt = f"it takes {FEWEST} seeds of each to decide"
    elif not learnt(best, study.headline, study.horizon):
        doubt = "it is not shown to have learnt"
    elif unsteady > STEADY:
        doubt = f"what runs of one method took differs by up to {unsteady:.1f} times"
    return Choice(best, write(outcome.median(best)), level, len(others), doubt)


def choices(
    study: Study, needs: Needs, rounds: Sequence[Study] = ()
) -> dict[str, dict[str, Choice | None]]:
    """The best method, by what there is and then by what is scarce.

    Methods that need something else besides are left out.

    Args:
        study: the runs.
        needs: of methods whose runs recorded none.
        rounds: the runs by the seconds of single rounds of timing, whose error the tests over seeds
            do not see.
    """
    ranked = budgets(study)
    found = {scarce: [decisions(study, outcome)] for scarce, outcome in ranked.items()}
    for each in rounds:
        found[SECONDS].append(decisions(each, budgets(each)[SECONDS]))
    return {
        there: {
            scarce: choose(
                study, usable(study, needs, have), outcome, found[scarce], spread(study, scarce)
            )
            for scarce, outcome in ranked.items()
        }
        for there, have in SITUATIONS.items()
    }


def usable(study: Study, needs: Needs, have: Collection[str]) -> list[Group]:
    """The compared methods that need nothing but what there is."""
    unknown = {"nobody knows"}
    return [group for group in study.compared if needs_of(group, needs, unknown) <= set(have)]


def ranking(study: Study, needs: Needs) -> Table:
    """Every method with what it needs, what it reaches for each budget, and what it costs."""
    ranked = budgets(study)
    groups = sorted(study.compared, key=lambda g: -np.mean(ranked["updates"].values(g)))
    rows: list[dict[str, Cell]] = []
    for group in groups:
        said = sorted(needs_of(group, needs, {"not declared"}))
        row: dict[str, Cell] = {"method": group.label, "needs": ", ".join(said) or "nothing"}
        row["seeds"] = len(group.runs)
        for outcome in ranked.values():
            row[outcome.name] = outcome.median(group)
        last = [run.last("evaluations") for run in group.runs]
        row["frames (M)"] = float(np.mean([run.total_frames[-1] for run in group.runs]) / 1e6)
        row["evaluations"] = int(np.mean(last))
        row["seconds"] = float(np.mean([run.own_seconds[-1] for run in group.runs]))
        rows.append(row)
    note = (
        f"{INTERVALS} Frames, evaluations of "
        "levels that the curriculum asked for, and seconds: means of whole runs."
    )
    return Table("ranking", "The methods", note, rows)

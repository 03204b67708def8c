"""What we say of our own methods, each with the evidence for or against it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from proposer_rl.report.comparisons import (
    ALIKE,
    TOO_FEW,
    Decision,
    between,
    decisions,
    difference,
    learnt,
    primary,
)
from proposer_rl.report.decision import TARGET, Needs, needs_of
from proposer_rl.report.findings import Evidence, beats_in
from proposer_rl.report.statistics import ERROR
from proposer_rl.report.studies import Group, Study
from proposer_rl.report.tables import write
from proposer_rl.runs.columns import is_rate

# The methods, by the labels of their groups.
OURS, PROPOSER, LITERAL = "first_order_gain", "first_order_proposer", "perf_gain, paper_literal"
EVEN, BY_HAND, NONE = "domain_randomization", "hand_designed", "target"


def own_findings(study: Study, needs: Needs) -> list[tuple[str, Evidence | None]]:
    """Our claims, and what the runs say of each; None where its methods are missing.

    Args:
        study: the runs.
        needs: what each method needs.
    """
    return [
        (
            "First-order gain beats domain randomization, the target alone and every method that "
            "is told no target.",
            _beats_all(study, needs),
        ),
        (
            "First-order gain is level with the curriculum by hand, or better.",
            _level_or_better(study),
        ),
        (
            "A Proposer that is paid for each problem by itself learns where the paper's literal "
            "one does not.",
            _learns_where_the_other_does_not(study),
        ),
    ]


def _beats_all(study: Study, needs: Needs) -> Evidence | None:
    one = study.group(OURS)
    untold = [
        group
        for group in study.compared
        if group is not one and TARGET not in needs_of(group, needs, {TARGET})
    ]
    even, none = study.group(EVEN), study.group(NONE)
    if one is None or even is None or none is None:
        return None
    others = [none, *untold]
    found = decisions(study)
    pairs = [between(found, one, other) for other in others]
    text = "; ".join(_against(study, one, *pair) for pair in pairs)
    text = f"{primary(study).name}, difference to {text}; {_frames(one, others)}"
    if any(decision.winner not in (None, one.label) for _, decision in pairs):
        return "contradicted", text
    if all(decision.winner == one.label for _, decision in pairs):
        return "supported", text
    few = all(decision.verdict == TOO_FEW for _, decision in pairs)
    return ("too few seeds" if few else "undecided"), text


def _level_or_better(study: Study) -> Evidence | None:
    one, hand = study.group(OURS), study.group(BY_HAND)
    if one is None or hand is None or not is_rate(study.headline):
        return None
    _, decision = pair = between(decisions(study), one, hand)
    low = difference(primary(study), one, hand).interval(1 - 2 * ERROR).low
    text = (
        f"{primary(study).name}, difference to {_against(study, one, *pair)}; level is taken as no "
        f"more than {ALIKE} below, by a one-sided test at 5 % (bound {write(float(low), 3)}); "
        f"{_frames(one, [hand])}"
    )
    if decision.verdict == TOO_FEW:
        return "too few seeds", text
    if decision.winner == hand.label:
        return "contradicted", text
    sure = low > -ALIKE and learnt(one, study.headline, study.horizon)
    return ("supported" if sure else "undecided"), text


def _learns_where_the_other_does_not(study: Study) -> Evidence | None:
    """Learning is to beat even draws; not to learn is to be shown not to be better than them."""
    paid, literal, even = (study.group(label) for label in (PROPOSER, LITERAL, EVEN))
    if paid is None or literal is None or even is None or not is_rate(study.headline):
        return None
    beats = beats_in(study)
    verdict, text = beats((paid, even))
    other, more = beats((literal, even))
    text = f"{paid.label} against {even.label}: {text}. {literal.label} against it: {more}"
    if "too few seeds" in (verdict, other):
        return "too few seeds", text
    high = difference(primary(study), literal, even).interval(1 - 2 * ERROR).high
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

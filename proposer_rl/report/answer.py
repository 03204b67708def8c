"""What a reader needs first: the results in two sentences, and what each method does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from proposer_rl.report.comparisons import (
    NOT_LEARNT,
    TOO_FEW,
    Decision,
    decisions,
    primary,
)
from proposer_rl.report.statistics import FEWEST
from proposer_rl.report.studies import Group, Study
from proposer_rl.report.tables import write
from proposer_rl.runs.records import LONGEST_TEXT, printable

# What methods and ablations do, by ``method`` or ``ablation`` and name.
Meanings = Mapping[str, Mapping[str, str]]

LISTED = 6  # methods that a sentence names


def answer(study: Study) -> tuple[str, str]:
    """Which method is best and how that is known, then the others against the baseline."""
    outcome, baseline = primary(study), study.baseline
    ranked = sorted(study.compared, key=lambda group: -np.mean(outcome.values(group)))
    best, *others = ranked
    median = write(outcome.median(best))
    if not others:
        return (
            f"{best.label} is the only method here ({outcome.name}: {median}, median over seeds).",
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
    """What a method does, in a line: as its runs recorded it, or else as the caller knows it."""
    run = group.runs[0]
    about = run.facts.get("about")
    own = about if isinstance(about, Mapping) else {}
    said = []
    for kind, name in (("method", run.method), ("ablation", run.ablation)):
        text = own.get(kind) or meanings.get(kind, {}).get(name, "")
        said.append(printable(str(text))[:LONGEST_TEXT])
    text = said[0] or "Its runs do not say what it does."
    text += f" Changed here: {said[1]}" if said[1] else ""
    return f"{text} ({group.setting})" if group.setting else text


def _shown(best: Group, found: Mapping[str, Decision]) -> str:
    """Whether the best is significantly better, and than how many of the others."""
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
    """How the others stand to the baseline."""
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

"""Prints ``bin/train --help`` with the names of all files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill

from proposer_rl.recipes import available, comments

USAGE = """\
Train a Solver on a curriculum.

  bin/train +method=NAME [+scale=NAME] [+ablation=NAME] [KEY=VALUE ...]
"""
EXAMPLES = """\
Examples:
  bin/train +method=perf_gain +scale=quick
  bin/train -m +method=perf_gain,target +scale=quick seed=0,1,2
  bin/train +method=perf_gain +scale=quick --cfg job   # every setting; nothing is run

-m runs every combination; --hydra-help lists the other options, all of them Hydra's."""
# What each group decides, in the usual order on the command line.
GROUPS = {
    "task=": "what is to be learnt",
    "+method=": "what the Solver trains on",
    "+scale=": "how much is computed",
    "+as=": "the numbers of another library, for methods that keep levels",
    "+score=": "where the scores of levels come from",
    "+filter=": "which of more levels are trained on",
    "+source=": "what knows the Solver's performance",
    "+ablation=": "what is changed of a method",
    "+sweep=": "many runs",
}
NEEDS, NOTHING = "Needs: ", "nothing."


def help_text() -> str:
    """Returns the usage, the names in each group and examples."""
    parts = [USAGE]
    for option, meaning in GROUPS.items():
        names = ", ".join(available(option.strip("+=")))
        listed = fill(names, 79, initial_indent="  ", subsequent_indent="  ")
        parts.append(f"{option} {meaning}\n{listed}\n")
    return "\n".join([*parts, EXAMPLES])


def choices(group: str, folders: Sequence[Path]) -> dict[str, str]:
    """Returns the choices of a group by name, each with the first line of its file.

    Args:
        group: such as ``method``.
        folders: of configurations; of two files with the same name the first counts, as in Hydra.
    """
    found: dict[str, str] = {}
    for folder in folders:
        for name in available(group, folder):
            found.setdefault(name, next(comments(folder / group / f"{name}.yaml"), ""))
    return dict(sorted(found.items()))


def needs(folders: Sequence[Path]) -> dict[str, list[str]]:
    """Returns what methods need, by name, from the lines ``# Needs:`` of their files."""
    found: dict[str, list[str]] = {}
    for folder in folders:
        for name in available("method", folder):
            lines = comments(folder / "method" / f"{name}.yaml")
            said = (line.removeprefix(NEEDS) for line in lines if line.startswith(NEEDS))
            for text in map(str.strip, said):
                needed = [] if text == NOTHING else [n.strip(" .") for n in text.split(",")]
                found.setdefault(name, needed)
    return found

"""A study in short, as Markdown: for where HTML is not shown, and beside its data."""

from __future__ import annotations

from collections.abc import Sequence

from proposer_rl.report import page
from proposer_rl.report.answer import answer
from proposer_rl.report.outcomes import against_baseline, group_table
from proposer_rl.report.studies import Study
from proposer_rl.report.tables import escape_markdown


def section(study: Study, figures: str) -> str:
    """What was compared, the answer, and the tables.

    Args:
        study: the runs.
        figures: how the addresses of its figures begin.
    """
    facts = page.facts(study) + page.origin(study)
    if incomplete := page.incomplete(study):
        text = f"Not finished, or shorter than {study.horizon} updates"
        facts = [*facts, (text, ", ".join(incomplete))]
    methods, pairs = group_table(study), against_baseline(study)
    parts = [
        f"## {escape_markdown(study.title)}",
        escape_markdown(" ".join(answer(study))),
        "\n".join(f"- {escape_markdown(f'{name}: {text}')}" for name, text in facts),
        f"![Learning curves and updates to the threshold]({figures}learning_curves.png)",
    ]
    for table in (methods, pairs):
        if table.rows:
            parts += [f"### {escape_markdown(table.title)}", escape_markdown(table.note)]
            parts.append(table.to_markdown().strip())
    commands = "\n".join(page.commands(study))
    return "\n\n".join([*parts, "### Commands", f"```bash\n{commands}\n```"])


def document(parts: Sequence[str], command: str, notes: Sequence[str]) -> str:
    """Parts of a page, and how it is made."""
    left_out = "\n".join(f"- Left out: {escape_markdown(note)}" for note in notes)
    made = f"The whole report is written by\n\n```bash\n{command}\n```"
    return "\n\n".join(filter(None, [*parts, left_out, made])) + "\n"

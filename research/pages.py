"""Two pages of a study, drawn from its runs: which curriculum to use, and which claims hold."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from proposer_rl.cli.errors import command, number
from proposer_rl.cli.help import needs
from proposer_rl.recipes import CONFIG_FOLDER
from proposer_rl.report import figures, measures, page
from proposer_rl.report.build import FIGURES, check_output, read_checked
from proposer_rl.report.comparisons import primary
from proposer_rl.report.measures import UPDATES
from proposer_rl.report.reading import OutputError
from proposer_rl.report.runs import STUDY
from proposer_rl.report.statistics import FEWEST, INTERVALS
from proposer_rl.report.studies import Study
from proposer_rl.report.style import Drawing, in_few_colours, render
from proposer_rl.report.tables import Table, escape_markdown
from proposer_rl.runs.folder import write_atomically
from proposer_rl.runs.records import words
from research.claims import GAIN, TITLE, Evidence, own_claims, paper_claims, rules
from research.generalisation import check_names, generalisation_table, read_scores
from research.ranking import (
    SITUATIONS,
    STEADY,
    Choice,
    Needs,
    budgets,
    choices,
    needs_of,
    ranking,
    usable,
)
from research.timing import read_timing, timed

CHOICE, CLAIMS = "which_curriculum.md", "claims.md"
SCARCE = ("updates of the Solver", "environment frames", "seconds")


def cost_curves(study: Study) -> Drawing:
    """Draws the headline against updates and against costs, including those of the curriculum."""
    measure = measures.measured(study)[study.headline]
    seconds = (
        "Seconds are of the whole process, including evaluation, or an even share where seeds were "
        "trained together. Compare them only between runs on equal machines."
    )
    if study.timed:
        seconds = (
            "Seconds are updates times the seconds of one, with all methods timed in turns on one "
            f"machine ({study.timed}) and without evaluations."
        )
    return Drawing(
        "cost",
        f"The same {words(study.headline)} against updates and against its whole cost",
        "Frames are the Solver's own and those that the curriculum spent on replicas or scoring. "
        + seconds,
        [
            partial(figures.draw_curves, study=study, measure=measure, axis=axis)
            for axis in measure.axes
        ],
        3,
        study.legend,
    )


def difficulty(study: Study) -> Drawing | None:
    """Draws statistics of the levels trained on; None where no run has recorded any."""
    every = measures.trained(study)
    shown = [g for g in study.groups if any(each.axes[UPDATES](g) is not None for each in every)]
    if not shown:
        return None
    return Drawing(
        "difficulty",
        "What the Solver trained on",
        "Statistics of the batch at each evaluated update: means, or standard deviations where the "
        "name says sd. Lines and bands are as above.",
        [partial(figures.draw_curves, study=study, measure=measure) for measure in every],
        3,
        {group.label: group.look for group in shown},
    )


# Of the page of claims.
DRAWINGS: Sequence[Callable[[Study], Drawing | None]] = (
    figures.learning_curves,
    cost_curves,
    figures.heat_maps,
    difficulty,
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point; the exit codes are those of :mod:`proposer_rl.cli.errors`."""
    command(partial(_answer, _parser().parse_args(arguments)))


def _answer(options: argparse.Namespace) -> None:
    folders, output, seconds = options.folder, options.output, options.seconds
    scores, threshold = options.scores, options.threshold
    baselines = [] if options.baseline is None else [options.baseline]
    needed = needs([CONFIG_FOLDER])  # by methods whose runs do not tell
    check_output(output, CHOICE, STUDY)
    studies, notes = read_checked(folders, threshold, baselines)
    if len(studies) > 1:
        titles = "; ".join(study.title for study in studies)
        raise OutputError(f"the runs were not measured alike ({titles}); give fewer")
    (study,) = studies
    if scores is not None:
        check_names(study.runs)
    given = {"--scores": [scores] if scores else [], "--seconds": seconds, "-o": [output]}
    more = [text for name, paths in given.items() if paths for text in (name, *map(str, paths))]
    made = page.report_command("bin/research pages", folders, threshold, baselines, *more)
    ranked, *rounds = timed(study, read_timing(seconds)) if seconds else [study]
    others = generalisation_table(study, [] if scores is None else read_scores(scores))
    files: dict[str, bytes] = {}
    pages = {
        CHOICE: _choice(ranked, rounds, needed, files),
        CLAIMS: _claims(ranked, needed, others, files),
    }
    for name, parts in pages.items():
        lines = [*parts, "## How this page is made", _origin(study, made, notes)]
        files[name] = ("\n\n".join(lines) + "\n").encode()
    (output / FIGURES).mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        write_atomically(output / name, content)
    for name in pages:
        print(f"Page: {output / name}")


def _choice(
    study: Study, rounds: Sequence[Study], needs: Needs, files: dict[str, bytes]
) -> list[str]:
    """The page for who wants to use a curriculum."""
    found = choices(study, needs, rounds)
    named = {c.best.label for row in found.values() for c in row.values() if c and not c.doubt}
    named |= {study.baseline.label}
    shown = replace(study, groups=tuple(g for g in study.groups if g.label in named))
    kept = [group.label for have in SITUATIONS.values() for group in usable(study, needs, have)]
    left = [group for group in study.compared if group.label not in kept]
    table = ranking(study, needs)
    parts = [
        f"# Which curriculum should I use? {_where(study)}",
        f"From {_runs(study)}. By what is available, and by what is scarce: the method with the "
        f"highest mean over seeds of {words(study.headline)} along training, over a "
        "budget of it; its median is shown.",
        _picture(cost_curves(shown)._replace(name="recommended"), files),
        _decision_table(found),
        _budgets(study),
    ]
    if left:
        also = (f"{g.label} ({', '.join(sorted(needs_of(g, needs, {'?'})))})" for g in left)
        parts.append(
            "Not chosen from, because they take something else, too, but in the table below: "
            f"{escape_markdown(', '.join(also))}."
        )
    seeds = {g.label: len(primary(study).values(g)) for g in study.compared if g.label in kept}
    thin = [label for label, count in seeds.items() if count < FEWEST]
    if 0 < len(thin) < len(seeds):
        parts.append(
            f"Not chosen from for want of {FEWEST} seeds: {escape_markdown(', '.join(thin))}."
        )
    return [*parts, f"## {table.title}", table.to_markdown().strip(), table.note]


def _decision_table(found: Mapping[str, Mapping[str, Choice | None]]) -> str:
    head = ["available", *(f"{scarce} are scarce" for scarce in SCARCE)]
    rows = [
        [there, *("–" if c is None else _cell(c) for c in row.values())]
        for there, row in found.items()
    ]
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(choice: Choice) -> str:
    label = escape_markdown(choice.best.label)
    rest = escape_markdown(choice.text().removeprefix(choice.best.label))
    return f"{label if choice.doubt else f'**{label}**'} {rest}"


def _budgets(study: Study) -> str:
    seconds = (
        "Seconds hold for the machine below, and for what else it did: where runs of one method "
        f"differ by more than {STEADY} times, none is chosen by them."
    )
    if study.timed:
        seconds = (
            "Seconds are updates times what an update of the method takes, all methods timed in "
            f"turns on one machine ({study.timed}): medians of the rounds; a difference counts "
            "only where each round alone finds it; measuring the Solver takes more."
        )
    names = "; ".join(outcome.name for outcome in budgets(study).values())
    return (
        f"Ranked by {names}. The budget of frames and of seconds is what the run that cost least "
        "spent on all of its updates: a method that spends more gets as far as that allows. "
        "*Significant*: by t tests over seeds, in pairs where methods have the same ones, "
        "corrected for all pairs of methods on this page by Holm's method, each column for "
        "itself, at 5 %; and the better one must have learnt. A method without a significant "
        "difference to the "
        f"best may be as good. {INTERVALS} *No target*: the "
        "method is target-free; what is measured is success on the target all the same. *Exact "
        "evaluation*: the task can compute the Solver's success on a level without episodes, with "
        "gradients. Some methods that need it here run on episodes, too, with `+score=sampled`, "
        "`+filter=learnability_sampled` or where a task is measured by episodes; so they have not "
        f"been compared here. {seconds}"
    )


def _claims(study: Study, needs: Needs, others: Table, files: dict[str, bytes]) -> list[str]:
    """The page for who wants to know what is true."""
    drawn = [drawing for draw in DRAWINGS if (drawing := draw(study)) is not None]
    # Strips under each other would be twice as high as a screen.
    drawn = [each._replace(columns=max(each.columns, 2)) for each in drawn]
    figures = {each.name: _picture(each, files) for each in drawn}
    about = {each.name: f"{each.title}. {each.caption}" for each in drawn}
    sections = {
        "What each curriculum proposes": "proposals",
        "What the Solver trained on, and its success there": "difficulty",
    }
    parts = [
        f"# What the paper claims and what we found {_where(study)}",
        f"From {_runs(study)}.",
        *(text for name in ("learning_curves", "cost") for text in (figures[name], about[name])),
        "## The paper's claims",
        f"The paper is *{TITLE}*, whose method is `{GAIN}`.",
        _list(paper_claims(study)),
        "## Our claims",
        _list(own_claims(study, needs)),
        "What each method costs in frames, evaluations and seconds stands in "
        f"[the table of methods]({CHOICE}#the-methods).",
        "## How it is decided",
        rules(study),
    ]
    for title, name in sections.items():
        if name in figures:
            parts += [f"## {title}", figures[name], about[name]]
    if len(others.columns) > 1:
        parts += [f"## {others.title}", others.to_markdown().strip(), others.note]
    return parts


def _list(found: Sequence[tuple[str, Evidence | None]]) -> str:
    lines = []
    for place, (claim, evidence) in enumerate(found, 1):
        verdict, text = evidence or (
            "not tested",
            "its methods, or what it is measured by, are not among these runs",
        )
        lines.append(f"{place}. {claim} **{verdict.capitalize()}**: {escape_markdown(text)}.")
    return "\n".join(lines)


def _picture(drawing: Drawing, files: dict[str, bytes]) -> str:
    path = f"{FIGURES}/{drawing.name}.png"
    (png,) = render(drawing, "png")
    files[path] = in_few_colours(png)
    return f"![{escape_markdown(drawing.title)}]({path})"


def _where(study: Study) -> str:
    return f"({escape_markdown(study.title)})"


def _runs(study: Study) -> str:
    seeds = sorted({len(group.runs) for group in study.groups})
    count = str(seeds[0]) if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]}"
    return (
        f"{len(study.runs)} runs: {len(study.groups)} methods or variants, {count} seeds of each, "
        f"{study.horizon} updates of the Solver, compared by {primary(study).name}"
    )


def _origin(study: Study, command_line: str, notes: Sequence[str]) -> str:
    facts = [f"- {escape_markdown(f'{name}: {text}')}" for name, text in page.origin(study)]
    if incomplete := page.incomplete(study):
        named = escape_markdown(", ".join(incomplete))
        facts.append(f"- Not finished, or shorter than {study.horizon} updates: {named}")
    facts += [f"- {escape_markdown(note)}" for note in notes]
    made = "\n".join(page.commands(study))
    return "\n\n".join(
        [
            f"```bash\n{command_line}\n```",
            "writes both pages from these runs, which were made by",
            f"```bash\n{made}\n```",
            "\n".join(facts),
        ]
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bin/research pages", description=__doc__)
    parser.add_argument("folder", nargs="+", type=Path, help="of a study or of runs")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for the pages")
    parser.add_argument("--threshold", type=number(float), help="of sample efficiency")
    parser.add_argument("--baseline", metavar="METHOD", help="as the report calls it")
    parser.add_argument(
        "--scores", type=Path, metavar="FILE", help="of these runs, by bin/research scores"
    )
    parser.add_argument(
        "--seconds",
        type=Path,
        nargs="+",
        default=[],
        metavar="FILE",
        help="of an update of each method, as bin/bench curricula --runs writes them; further "
        "files, of methods timed later beside some of those",
    )
    return parser


if __name__ == "__main__":
    main()

"""``bin/eval`` and ``proposer-eval``: a trained Solver on named levels, one by one."""

from __future__ import annotations

import argparse
import csv
import io
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text
from tensordict import TensorDict

from proposer_rl.cli.build import make_task
from proposer_rl.cli.config import ConfigError, RunConfig, saved_config
from proposer_rl.cli.errors import FORESEEN, refuse
from proposer_rl.mazes import Level
from proposer_rl.mazes.level_files import SUFFIXES, read_levels, shipped_levels, shipped_sets
from proposer_rl.mazes.level_pictures import draw_paths
from proposer_rl.mazes.level_scores import Score, score_levels
from proposer_rl.mazes.task import MazeTask
from proposer_rl.models import ActorCritic
from proposer_rl.runs.checkpoint import CheckpointError, State, load_checkpoint, load_latest
from proposer_rl.runs.folder import write_atomically
from proposer_rl.streams import Streams

SHOWN = 36  # levels in the table and on the sheet of pictures
SLACK = 2  # of a named level: steps allowed for each move of its shortest path
MOST_STEPS = 10**5
OUTPUTS = (".json", ".csv")


@dataclass(frozen=True)
class Evaluation:
    """What an evaluation found.

    Attributes:
        run: The run's folder.
        updates: Solver updates made at the checkpoint.
        seeds: Of the run's Solvers, in their order.
        levels: The levels by their names.
        scores: One for each level and Solver.
    """

    run: Path
    updates: int
    seeds: list[int]
    levels: Mapping[str, Level]
    scores: list[Score]

    def rows(self) -> list[dict[str, Any]]:
        """One mapping for each level and Solver, for JSON and CSV."""
        return [
            {
                "run": self.run.name,
                "seed": self.seeds[score.solver],
                "updates": self.updates,
                "level": score.level,
                "height": score.height,
                "width": score.width,
                "path_length": score.path_length,
                "max_steps": score.max_steps,
                "success": score.success,
                "return": score.mean_return,
                "greedy_success": score.greedy_success,
                "greedy_return": score.greedy_return,
            }
            for score in self.scores
        ]


class _Choice(NamedTuple):
    """Levels, and the step limit of one of them, given the length of its shortest path."""

    levels: Mapping[str, Level]
    max_steps: Callable[[int], int]


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point; the exit codes are those of :mod:`proposer_rl.cli.errors`."""
    options = _parser().parse_args(arguments)
    try:
        _check_file("--output", options.output, OUTPUTS)
        _check_file("--pictures", options.pictures, (".png",))
        found = evaluate(options.checkpoint, options.levels, options.max_steps)
        _print(found, options.levels)
        if options.output is not None:
            write_atomically(options.output, _encoded(found.rows(), options.output.suffix))
        if options.pictures is not None:
            title = f"{found.run.name}, {found.updates} updates"
            shown = [score for score in found.scores if score.solver == 0]
            picture = draw_paths(found.levels, _hardest(shown), title)
            write_atomically(options.pictures, picture)
    except FORESEEN as error:
        refuse(error)
    except ValueError as error:
        refuse(ConfigError(str(error)))


def evaluate(checkpoint: Path, name: str, max_steps: int | None = None) -> Evaluation:
    """Evaluates the Solvers of a checkpoint, exactly.

    Args:
        checkpoint: A run's folder, for its newest checkpoint, or a checkpoint in it.
        name: A file of levels, a distribution of the run, or a set that comes along.
        max_steps: Step limit of every level. None: on a distribution that of the run, so that
            the means are those in its metrics; on other levels at least twice the shortest path.

    Raises:
        ConfigError, CheckpointError: If there is no such run, or its checkpoint cannot be used.
        ValueError: If there are no such levels, or the Solver cannot see levels that small.
        OSError: If a file cannot be read.
    """
    run, state = _read(checkpoint)
    config = saved_config(run)
    task = make_task(config)
    chosen = _choose(name, task)
    _check_sizes(chosen.levels, config)
    scores = score_levels(
        _solver(run, config, task, state),
        chosen.levels,
        chosen.max_steps if max_steps is None else lambda _: max_steps,
        config.maze.step_penalty,
        task.device,
    )
    return Evaluation(run, int(state["updates"]), config.seeds, chosen.levels, scores)


def _read(checkpoint: Path) -> tuple[Path, State]:
    """The run's folder, and the state in the checkpoint."""
    if not checkpoint.exists():
        raise ConfigError(f"{checkpoint}: there is no such file or folder")
    if not checkpoint.is_dir():
        return checkpoint.resolve().parent.parent, load_checkpoint(checkpoint)[1]
    latest = load_latest(checkpoint / "checkpoints")
    if latest is None:
        raise ConfigError(
            f"{checkpoint}: holds no checkpoints; give a run's folder or a checkpoint"
        )
    return checkpoint.resolve(), latest[1]


def _solver(run: Path, config: RunConfig, task: MazeTask, state: State) -> ActorCritic:
    learner = task.solvers([Streams(seed) for seed in config.seeds])
    try:
        learner.restore(TensorDict(state["solver"], [len(config.seeds)]))
        int(state["updates"])
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise CheckpointError(
            f"{run}: its checkpoint holds no Solver with the network of its config.json"
        ) from error
    return learner.agent


def _choose(name: str, task: MazeTask) -> _Choice:
    limit = task.maze.max_steps
    if Path(name).suffix in SUFFIXES:
        if not Path(name).is_file():
            raise ConfigError(f"--levels {name}: there is no such file")
        return _Choice(read_levels(name), lambda length: max(limit, SLACK * length))
    for distribution in task.distributions:
        if name.casefold() == distribution.casefold():
            levels = task.evaluation_levels(distribution).cpu()
            named = {f"{distribution}_{i:03}": levels[i] for i in range(len(levels))}
            return _Choice(named, lambda _: limit)
    if name in shipped_sets():
        return _Choice(shipped_levels(name), lambda length: max(limit, SLACK * length))
    known = ", ".join([*task.distributions, *shipped_sets()])
    raise ConfigError(
        f"--levels {name}: must be a file that ends in {' or '.join(SUFFIXES)}, or one of: {known}"
    )


def _check_sizes(levels: Mapping[str, Level], config: RunConfig) -> None:
    least = 2 ** (len(config.solver.channels) - 1)
    for name, level in levels.items():
        height, width = level.walls.shape
        if min(height, width) < least:
            raise ConfigError(
                f"level {name!r}: its {height}x{width} cells are halved to nothing by this Solver; "
                f"it sees levels of {least}x{least} cells and more"
            )


def _check_file(option: str, file: Path | None, suffixes: Sequence[str]) -> None:
    if file is None:
        return
    if file.suffix not in suffixes:
        raise ConfigError(f"{option} {file}: must end in {' or '.join(suffixes)}")
    if not file.parent.is_dir():
        raise ConfigError(f"{option} {file}: there is no folder {file.parent}")


def _encoded(rows: list[dict[str, Any]], suffix: str) -> bytes:
    if suffix == ".json":
        return (json.dumps(rows, indent=1) + "\n").encode()
    file = io.StringIO(newline="")
    writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return file.getvalue().encode()


def _print(found: Evaluation, name: str) -> None:
    first = [score for score in found.scores if score.solver == 0]
    shown = _hardest(first)
    some = f", the {len(shown)} hardest of {len(first)} levels" if len(shown) < len(first) else ""
    seeds = ", ".join(map(str, found.seeds))
    table = Table(
        box=SIMPLE_HEAD,
        title=Text(f"{found.run.name}, seed {seeds}, {found.updates} updates: {name}{some}"),
        caption="Exact probability of reaching the goal within the steps, and expected return; "
        "greedy: whether the most probable actions get there."
        + (" Means over the seeds." if len(found.seeds) > 1 else ""),
    )
    table.add_column("level", overflow="fold", min_width=16)
    for column in ("size", "path", "steps", "success", "return", "greedy"):
        table.add_column(column, justify="right")
    for score in shown:
        size = f"{score.height}x{score.width}"
        of_level = [other for other in found.scores if other.level == score.level]
        table.add_row(
            Text(score.level), size, str(score.path_length), str(score.max_steps), *_means(of_level)
        )
    table.add_section()
    table.add_row(f"mean of {len(first)}", "", "", "", *_means(found.scores))
    Console().print(table)


def _hardest(scores: Sequence[Score]) -> list[Score]:
    """All of a few levels; of many those with the least success, in their order."""
    kept = {score.level for score in sorted(scores, key=lambda s: s.success)[:SHOWN]}
    return [score for score in scores if score.level in kept]


def _means(scores: Sequence[Score]) -> list[str]:
    def mean(key: str) -> float:
        return sum(float(getattr(score, key)) for score in scores) / len(scores)

    return [f"{mean('success'):.1%}", f"{mean('mean_return'):.3f}", f"{mean('greedy_success'):.0%}"]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="bin/eval",
        description="Evaluates a trained Solver on levels of any size, one by one: success and "
        "return of the sampled and of the greedy policy, exactly.",
        epilog="docs/levels.md describes the files of levels and the sets that come along.",
    )
    parser.add_argument("checkpoint", type=Path, help="a run's folder, or one of its checkpoints")
    parser.add_argument(
        "--levels", default="shapes", metavar="FILE|NAME",
        help=f"a file that ends in {' or '.join(SUFFIXES)}, a distribution of the run such as id "
        f"or ood, or a set that comes along: {', '.join(shipped_sets())} (shapes)",
    )  # fmt: skip
    parser.add_argument(
        "--max-steps", type=_steps, metavar="N",
        help="step limit of every level (a distribution: the run's; others: that, or "
        f"{SLACK} for each move of the shortest path if this is more)",
    )  # fmt: skip
    parser.add_argument(
        "-o", "--output", type=Path, help="a file for the rows that ends in .json or .csv"
    )
    parser.add_argument(
        "--pictures", type=Path, help="a file that ends in .png for the levels with the paths taken"
    )
    return parser


def _steps(text: str) -> int:
    number = int(text)
    if not 1 <= number <= MOST_STEPS:
        raise argparse.ArgumentTypeError(f"must be from 1 to {MOST_STEPS:,}, got {number}")
    return number


if __name__ == "__main__":
    main()

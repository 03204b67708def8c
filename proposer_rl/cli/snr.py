"""``bin/snr`` and ``proposer-snr``: the signal-to-noise ratio of the Proposer's reward in a run."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from signal import SIGINT
from typing import Any, NoReturn

import torch
from rich.console import Console
from rich.table import Table
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.distributions import Dirichlet
from tqdm import tqdm

from proposer_rl.cli.build import make_task
from proposer_rl.cli.config import ConfigError, RunConfig, saved_config
from proposer_rl.cli.errors import BAD_INPUT, SIGNALLED
from proposer_rl.mazes.task import MazeTask
from proposer_rl.meta.actions import Mixture, ProblemChoices, Proposals
from proposer_rl.meta.env import SolverTrainingEnv
from proposer_rl.meta.rewards import performance_gain
from proposer_rl.meta.signal import by_validation_size, total_gains
from proposer_rl.meta.view import SolverView
from proposer_rl.methods import MEASURES
from proposer_rl.runs.checkpoint import CheckpointError, load_checkpoint
from proposer_rl.runs.folder import write_atomically
from proposer_rl.streams import Streams

UNEVEN = 0.15  # concentration of the Dirichlet distribution of uneven mixtures


def main() -> None:
    """Entry point: exit code 0, 2 for bad input, 130 when interrupted."""
    arguments = _parser().parse_args()
    try:
        rows = measure(arguments)
    except (ConfigError, CheckpointError, ValueError, OSError) as error:
        refuse(str(error))
    except KeyboardInterrupt:
        sys.exit(SIGNALLED + SIGINT)
    _print(rows)
    if arguments.output is not None:
        write_atomically(arguments.output, (json.dumps(rows, indent=1) + "\n").encode())


def measure(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """A row for every checkpoint, exploration, measure and validation size.

    Raises:
        ConfigError, CheckpointError: if a folder is no run's, or a checkpoint cannot be read.
        ValueError: if a number is out of range.
    """
    output = arguments.output
    if output is not None and not output.parent.is_dir():
        raise ConfigError(f"--output: there is no folder {output.parent}")
    unknown = [name for name in arguments.explorations if name not in EXPLORATIONS]
    if unknown:
        raise ConfigError(
            f"--explorations: must be among {', '.join(EXPLORATIONS)}, got {unknown[0]!r}"
        )
    found = [(folder, file) for folder in arguments.folders for file in checkpoints(folder)]
    work = [(folder, file, name) for folder, file in found for name in arguments.explorations]
    rows = []
    for folder, file, name in tqdm(work, desc="explorations", disable=not sys.stderr.isatty()):
        rows += _measure(folder, file, name, arguments)
    return rows


def _measure(
    folder: Path, file: Path, exploration: str, arguments: argparse.Namespace
) -> list[dict[str, Any]]:
    config = saved_config(folder)
    task = make_task(config)
    step, state = load_checkpoint(file)
    solver = TensorDict(state["solver"], [1])[0]
    lookahead = arguments.lookahead or config.proposer.lookahead
    streams = Streams(arguments.seed, "snr", folder.name, step)
    proposals, held, draw = EXPLORATIONS[exploration](task, config, lookahead)
    env = _environment(task, proposals, lookahead, held, arguments)
    actions = draw(env.steps, arguments.proposals, streams.generator("actions"))
    most = max(arguments.levels)
    levels = task.sample_target(most, streams.generator("levels", device=task.device))

    def all_measures(performance: TensorDictBase) -> Tensor:
        return torch.stack([MEASURES[name](performance) for name in arguments.measures], -1)

    gains = total_gains(
        env,
        solver,
        actions.to(task.device),
        levels,
        task.evaluate,
        streams.within(exploration),
        all_measures,
    )
    return [
        {
            "run": folder.name,
            "updates": state["updates"],
            "exploration": exploration,
            "measure": measure,
            "lookahead": lookahead,
            "levels": size,
            **asdict(signal),
        }
        for measure, own in zip(arguments.measures, gains.cpu().unbind(-1), strict=True)
        for size, signal in by_validation_size(own, arguments.levels).items()
    ]


def _environment(
    task: MazeTask,
    proposals: Proposals,
    lookahead: int,
    held: bool,
    arguments: argparse.Namespace,
) -> SolverTrainingEnv:
    copies = arguments.proposals * arguments.copies

    def nothing(*_: object) -> TensorDict:
        return TensorDict({"return": torch.zeros(copies, 1, device=task.device)}, [copies, 1])

    # The gain is measured before and after the episode only, not by the environment at every step.
    view = SolverView(
        target=task.sample_target,
        evaluate=nothing,
        probe=task.probe,
        validation_levels=1,
        probe_levels=0,
        device=task.device,
    )
    return SolverTrainingEnv(
        task.solvers([Streams(0)] * copies),
        view=view,
        proposals=proposals,
        reward=performance_gain,
        episode_length=lookahead,
        updates_per_step=lookahead if held else 1,
    )


# The meaning of actions, whether one holds for the episode, and how to draw those of G proposals
# in T steps, [T, G, ...].
_Exploration = tuple[Proposals, bool, Callable[[int, int, torch.Generator], Tensor]]


def _even(task: MazeTask, config: RunConfig, lookahead: int) -> _Exploration:
    """All proposals are the even mixture: there is nothing to learn, the ratio must be 0."""
    mixture = Mixture(task.directions("all"), task.generate)
    size = task.space.size
    return mixture, True, lambda steps, groups, generator: torch.zeros(steps, groups, size)


def _problems(task: MazeTask, config: RunConfig, lookahead: int) -> _Exploration:
    """Every problem's choice is drawn from one even policy (the paper's Proposer at its start)."""
    size, problems = task.space.size, task.solver.problems
    choices = ProblemChoices(size, task.generate)
    return (
        choices,
        False,
        lambda steps, groups, generator: torch.randint(
            size, (steps, groups, problems), generator=generator
        ),
    )


def _mixture(task: MazeTask, config: RunConfig, lookahead: int) -> _Exploration:
    """Mixtures as the run's settings draw them at first, held for the episode."""
    directions, spread = task.directions(config.proposer.directions), config.proposer.spread
    return (
        Mixture(directions, task.generate),
        True,
        lambda steps, groups, generator: (
            spread * torch.randn(steps, groups, directions.shape[0], generator=generator)
        ),
    )


def _uneven(task: MazeTask, config: RunConfig, lookahead: int) -> _Exploration:
    """Very uneven mixtures, Dirichlet(0.15) over all choices, held for the episode."""
    size = task.space.size

    def draw(steps: int, groups: int, generator: torch.Generator) -> Tensor:
        # Torch's Dirichlet takes no generator: its default one draws from this one's stream.
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(generator.initial_seed())
            shares = Dirichlet(torch.full((size,), UNEVEN)).sample((steps, groups))
        return shares.clamp_min(1e-6).log()

    return Mixture(task.directions("all"), task.generate), True, draw


EXPLORATIONS = {"even": _even, "problems": _problems, "mixture": _mixture, "uneven": _uneven}


def _print(rows: list[dict[str, Any]]) -> None:
    for run in dict.fromkeys(row["run"] for row in rows):
        own = [row for row in rows if row["run"] == run]
        table = Table(
            "updates", "exploration", "measure", "levels",
            "mean gain", "noise", "signal", "ratio", "95 %",
            title=f"{run}: total gain over {own[0]['lookahead']} updates",
            caption="noise, signal: standard deviations within and between proposals; "
            "ratio: of their squares, with its confidence interval",
        )  # fmt: skip
        for row in own:
            table.add_row(
                str(row["updates"]), row["exploration"], row["measure"], str(row["levels"]),
                *(f"{row[key]:.4f}" for key in ("mean", "noise", "signal")),
                f"{row['ratio']:.2f}", f"{row['low']:.2f} - {row['high']:.2f}",
            )  # fmt: skip
        Console().print(table)


def checkpoints(folder: Path) -> list[Path]:
    """All checkpoints of a run, oldest first.

    Raises:
        ConfigError: if there are none.
    """
    files = sorted((folder / "checkpoints").glob("step_*.pt"))
    if not files:
        raise ConfigError(f"{folder}: holds no checkpoints; give the folders of runs")
    return files


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="bin/snr",
        description="Measures how much of the Proposer's reward is due to what was proposed. From "
        "every checkpoint of the given runs, copies of the Solver follow different proposals, "
        "several copies each; an analysis of variance splits their gains into signal and noise.",
        epilog="Explorations: "
        + " ".join(f"{name}: {(make.__doc__ or '').strip()}" for name, make in EXPLORATIONS.items())
        + " A run keeps a checkpoint of every stage with schedule.keep_checkpoints=1000.",
    )
    parser.add_argument("folders", nargs="+", type=Path, help="folders of runs")
    parser.add_argument("--lookahead", type=_positive, help="updates of an episode; the run's")
    parser.add_argument("--proposals", type=_positive, default=8, help="different proposals (8)")
    parser.add_argument("--copies", type=_positive, default=3, help="copies of each (3)")
    parser.add_argument(
        "--levels", type=_positive, nargs="+", default=[75, 256, 1024],
        help="sizes of the validation batch (75 256 1024)",
    )  # fmt: skip
    parser.add_argument(
        "--explorations", nargs="+", default=list(EXPLORATIONS), metavar="NAME",
        help=f"among {', '.join(EXPLORATIONS)} (all)",
    )  # fmt: skip
    parser.add_argument(
        "--measures", nargs="+", default=list(MEASURES), choices=list(MEASURES),
        help="what gain is counted in (both)",
    )  # fmt: skip
    parser.add_argument("--seed", type=int, default=0, help="of all draws (0)")
    parser.add_argument("--output", type=Path, help="a JSON file for the rows")
    return parser


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, got {number}")
    return number


def refuse(message: str) -> NoReturn:
    """Say in one line what is wrong with the input, and exit."""
    print(f"error: {message}", file=sys.stderr)
    sys.exit(BAD_INPUT)


if __name__ == "__main__":
    main()

"""``bin/eval``, ``bin/foresight``, ``bin/look`` and ``bin/snr``: what is asked of trained runs.

Each is answered by the module of its name. That takes seconds to import, so help and refusals come
before it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from importlib import import_module
from pathlib import Path

from proposer_rl.cli.arguments import number
from proposer_rl.cli.errors import command

MOST_STEPS = 10**5
EXPLORATIONS = {
    "even": "All proposals are the even mixture: there is nothing to learn, the ratio must be 0.",
    "problems": "Every level's bin is drawn from one even policy (the paper's Proposer at its "
    "start).",
    "mixture": "Mixtures as a Proposer draws them at first, held for the episode.",
    "uneven": "Very uneven mixtures, Dirichlet(0.15) over all bins, held for the episode.",
}
MEASURES = ("return", "log_success")
STAGES = "A run keeps a checkpoint of every stage with schedule.keep_checkpoints=1000."


def evaluate(arguments: Sequence[str] | None = None) -> None:
    """``bin/eval``: trained Solvers on named levels."""
    _answer("evaluate", _evaluate_parser().parse_args(arguments))


def foresight(arguments: Sequence[str] | None = None) -> None:
    """``bin/foresight``: how far ahead does first-order gain look?"""
    _answer("foresight", _foresight_parser().parse_args(arguments))


def look(arguments: Sequence[str] | None = None) -> None:
    """``bin/look``: does a Proposer look at the Solver?"""
    _answer("look", _look_parser().parse_args(arguments))


def snr(arguments: Sequence[str] | None = None) -> None:
    """``bin/snr``: the signal-to-noise ratio of the Proposer's reward in a run."""
    _answer("snr", _snr_parser().parse_args(arguments))


def _answer(module: str, options: argparse.Namespace) -> None:
    """The exit codes are those of :mod:`proposer_rl.cli.errors`."""
    command(partial(_run, module, options))


def _run(module: str, options: argparse.Namespace) -> None:
    from proposer_rl.cli.config import ConfigError

    for option, suffixes in options.files.items():
        file: Path | None = getattr(options, option)
        if file is not None and file.suffix not in suffixes:
            raise ConfigError(f"--{option} {file}: must end in {' or '.join(suffixes)}")
        if file is not None and not file.parent.is_dir():
            raise ConfigError(f"--{option} {file}: there is no folder {file.parent}")
    body = import_module(f"proposer_rl.cli.{module}")
    try:
        body.run(options)
    except ValueError as error:
        raise error if hasattr(error, "exit_code") else ConfigError(str(error)) from error


def _evaluate_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="bin/eval",
        description="Evaluate a trained Solver on named levels, one by one: as exactly as its task "
        "can, on levels of any size where it has files of them.",
        epilog="docs/levels.md describes such files and the sets that come along.",
    )
    parser.add_argument(
        "checkpoint",
        nargs="+",
        type=Path,
        help="a run's folder, or one of its checkpoints; several folders of runs, or one with runs "
        "in it, for a table of methods, which takes no checkpoints",
    )
    parser.add_argument(
        "--levels",
        metavar="FILE|NAME",
        nargs="+",
        default=[],
        help="a distribution of the run such as id or ood; where the task has files of levels also "
        "one that ends in .txt or .json, a run's curriculum.jsonl, or a set that comes along: "
        "shapes, the default there, or small; where levels are grids, NAME@HxW is a distribution "
        "on another one; several for a table of methods, of runs' folders",
    )
    parser.add_argument(
        "--max-steps",
        type=number(int, 1, MOST_STEPS),
        metavar="N",
        help="step limit of every level, where the task lets it be chosen (the run's, or on levels "
        "that are none of a distribution 2 for each move of the shortest path if this is more)",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        help="a file for the rows that ends in .json or .csv; of several runs their means, and "
        "those that are in it are not computed again",
    )
    parser.add_argument(
        "--pictures", type=Path, help="a file that ends in .png for the levels with the paths taken"
    )
    parser.set_defaults(files={"output": (".json", ".csv"), "pictures": (".png",)})
    return parser


def _foresight_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="bin/foresight",
        description="Compare first-order gain with what training brings: from every checkpoint, "
        "copies of the Solver train on different mixtures, and their gains on the target after "
        "some updates are held against those predicted without any training.",
        epilog=STAGES,
    )
    parser.add_argument("folders", nargs="+", type=Path, help="folders of runs")
    parser.add_argument(
        "--ahead", type=number(int, 1), nargs="+", default=[1, 5, 20, 50],
        help="numbers of updates after which gains are measured (1 5 20 50)",
    )  # fmt: skip
    parser.add_argument(
        "--proposals", type=number(int, 4), default=16, help="different mixtures (16)"
    )
    parser.add_argument("--copies", type=number(int, 1), default=2, help="copies of each (2)")
    parser.add_argument("--levels", type=number(int, 1), default=512, help="of the target (512)")
    return _writing_rows(parser, "of all draws")


def _look_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="bin/look",
        description="Shows what a Proposer proposes to Solvers at several stages of training, and "
        "what changes when it is shown the probes or the return of another Solver. If nothing "
        "does, it does not look.",
        epilog=STAGES,
    )
    parser.add_argument("proposer", type=Path, help="folder of a run with a Proposer")
    parser.add_argument("solvers", type=Path, help="folder of a run; all its checkpoints are shown")
    return _writing_rows(parser, "of the levels it looks at")


def _snr_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="bin/snr",
        description="Measures how much of the Proposer's reward is due to what was proposed. From "
        "every checkpoint of the given runs, copies of the Solver follow different proposals, "
        "several copies each; an analysis of variance splits their gains into signal and noise.",
        epilog="Explorations: "
        + " ".join(f"{name}: {about}" for name, about in EXPLORATIONS.items())
        + f" {STAGES}",
    )
    parser.add_argument("folders", nargs="+", type=Path, help="folders of runs")
    parser.add_argument(
        "--meta-episode-length", type=number(int, 1), help="updates of an episode; the run's"
    )
    parser.add_argument(
        "--proposals", type=number(int, 2), default=8, help="different proposals (8)"
    )
    parser.add_argument("--copies", type=number(int, 2), default=3, help="copies of each (3)")
    parser.add_argument(
        "--levels", type=number(int, 1), nargs="+", default=[75, 256, 1024],
        help="sizes of the validation batch (75 256 1024)",
    )  # fmt: skip
    parser.add_argument(
        "--explorations", nargs="+", default=list(EXPLORATIONS), choices=list(EXPLORATIONS),
        help="ways in which proposals differ (all)",
    )  # fmt: skip
    parser.add_argument(
        "--measures", nargs="+", choices=MEASURES,
        help="what gain is counted in (both, as far as the task tells them)",
    )  # fmt: skip
    return _writing_rows(parser, "of all draws")


def _writing_rows(parser: argparse.ArgumentParser, seed: str) -> argparse.ArgumentParser:
    """With the options of every instrument whose answer is rows; what the seed is of."""
    parser.add_argument("--seed", type=int, default=0, help=f"{seed} (0)")
    parser.add_argument("-o", "--output", type=Path, help="a JSON file for the rows")
    parser.set_defaults(files={"output": (".json",)})
    return parser


def main() -> None:
    """What the commands in ``bin/`` start; the first argument is the command's name."""
    named = {"eval": evaluate, "foresight": foresight, "look": look, "snr": snr}
    named[sys.argv[1]](sys.argv[2:])


if __name__ == "__main__":
    main()

"""Curricula in training loops that are not this package's: stock parts and a Teacher.

The development half, on which curricula may be tuned:

- ``sparse``: TorchRL's PPO with 32 point masses in wind, rewarded at the goal alone, which uniform
  levels reach in 9 % of episodes at first.
- ``dense``: the same with 16 point masses, rewarded for getting nearer.
- ``truck``: TorchRL's DQN with 8 trucks that back a trailer to a dock, rewarded there alone.

The report half, on which nothing is tuned. Its two loops have what the others lack:

- ``crane``: TorchRL's SAC with 8 cranes that bring a hanging load to rest. Actions are continuous,
  every step has a cost, episodes never end early, and no reward says what a success is.
- ``lander``: REINFORCE in plain Python on one Gymnasium environment. Three of ten parameters have
  an effect, the policy does not see them, and the only reward is that of a soft landing.

Their sizes were chosen by the success of ``domain_randomization`` alone, on seeds 0 to 2, so that
its success on the target rises within a run; no other curriculum was run on them before.
"""

from __future__ import annotations

import argparse
import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

import proposer_rl as prl
from proposer_rl.cli.errors import check_file, command
from research.common import write_rows
from research.loops.crane import CRANE
from research.loops.lander import LANDER
from research.loops.truck import TRUCK
from research.loops.wind import DENSE, SPARSE

LOOPS = {"sparse": SPARSE, "dense": DENSE, "truck": TRUCK, "crane": CRANE, "lander": LANDER}
SEEDS = {"develop": range(20, 28), "report": range(100, 110)}


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point; the exit codes are those of :mod:`proposer_rl.cli.errors`."""
    parser = argparse.ArgumentParser(
        prog="bin/research loops",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="Runs whose rows are in the output are skipped, so that the same command goes on.",
    )
    parser.add_argument("methods", nargs="+", help="names of curricula")
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--loop", choices=LOOPS, nargs="+", default=[])
    which.add_argument("--half", choices=SEEDS, help="all loops of a half")
    parser.add_argument("--seeds", type=int, nargs="+", help="(20 to 27; report half 100 to 109)")
    parser.add_argument(
        "--settings",
        type=json.loads,
        default={},
        help="of the curricula, such as '{\"delta\": 0.4}'",
    )
    parser.add_argument("--iterations", type=int, help="of training (those of the loop)")
    parser.add_argument("-o", "--output", type=Path, help="a JSON file for the rows")
    options = parser.parse_args(arguments)
    command(lambda: compare(options))


def compare(options: argparse.Namespace) -> None:
    """Trains every method with every seed in every loop, and prints a table of each loop."""
    check_file("output", options.output, ".json")
    torch.set_num_threads(1)
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it tells of every buffer
    stored = options.output is not None and options.output.exists()
    rows: list[dict[str, Any]] = json.loads(options.output.read_text()) if stored else []
    curves = {json.dumps({**row, "success": None}): row["success"] for row in rows}
    names = options.loop or [name for name in LOOPS if LOOPS[name].half == options.half]
    for name in names:
        loop = LOOPS[name]
        iterations = options.iterations or loop.iterations
        table = Table("method", "along training", "at the end", "of each seed", title=name)
        for method in options.methods:
            found = []
            for seed in options.seeds or SEEDS[loop.half]:
                row: dict[str, Any] = {"loop": name, "method": method, "seed": seed}
                row |= {"settings": options.settings, "iterations": iterations, "success": None}
                curve = curves.get(json.dumps(row))
                if curve is None:
                    curriculum = getattr(prl.curricula, method)(**options.settings)
                    curve = loop.run(curriculum, seed, iterations)
                    rows.append({**row, "success": curve})
                    write_rows(rows, options.output)
                found.append(curve)
            means = torch.tensor(found)
            ends = means[:, -1]
            numbers = [f"{float(one.mean()):.3f}" for one in (means, ends)]
            table.add_row(method, *numbers, " ".join(f"{end:.2f}" for end in ends.tolist()))
        Console().print(table)


if __name__ == "__main__":
    main()

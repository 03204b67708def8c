"""How often intervals over few seeds hold what they are of, by simulation.

Every law is drawn many times with 5 and 10 seeds; the laws are those that runs were seen to vary
by. The page says what the report's interval promises, and why it is none of a mean.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import stats

from proposer_rl.cli.errors import command, number
from proposer_rl.report.statistics import CONFIDENCE, HELD, median_of
from proposer_rl.runs.folder import write_atomically

Array = NDArray[np.float64]
Law = Callable[[np.random.Generator, tuple[int, ...]], Array]
Ends = tuple[Any, Any]

SEEDS = (5, 10)
TRUTH = 10**6  # draws that a law's mean and median are taken from
RESAMPLES = 200
FAILING = 0.2
ALPHA = 1 - CONFIDENCE

LAWS: dict[str, Law] = {
    "normal": lambda rng, shape: rng.normal(0.5, 0.1, shape),
    "lognormal (σ = 0.65)": lambda rng, shape: rng.lognormal(0, 0.65, shape),
    "rates near 1 (beta(20, 1))": lambda rng, shape: rng.beta(20, 1, shape),
    "one run in five fails": lambda rng, shape: np.where(
        rng.random(shape) < FAILING, rng.beta(2, 18, shape), rng.beta(90, 10, shape)
    ),
    "half cut off at a horizon": lambda rng, shape: rng.lognormal(0, 0.5, shape).clip(max=1.0),
}


def student(rows: Array, rng: np.random.Generator) -> Ends:
    """Student's interval of the mean."""
    half = stats.t.ppf(1 - ALPHA / 2, rows.shape[1] - 1) * stats.sem(rows, 1)
    return rows.mean(1) - half, rows.mean(1) + half


def bootstrap_t(rows: Array, rng: np.random.Generator) -> Ends:
    """The bootstrap-t interval of the mean (Efron, SIAM Monograph 38, 1982)."""
    places = rng.integers(0, rows.shape[1], (RESAMPLES, *rows.shape))
    drawn = np.take_along_axis(rows[None], places, 2)
    spread = np.maximum(stats.sem(drawn, 2), 1e-12)  # of a resample of one value: as good as none
    low, high = np.quantile((drawn.mean(2) - rows.mean(1)) / spread, [ALPHA / 2, 1 - ALPHA / 2], 0)
    error = stats.sem(rows, 1)
    return rows.mean(1) - high * error, rows.mean(1) - low * error


def unseen(rows: Array, rng: np.random.Generator) -> Ends:
    """Student's interval, wider by what runs of a kind that was not seen could add, within [0, 1].

    Their share may be up to 1 - 0.025^(1/n) (Clopper & Pearson, Biometrika 26, 1934, of none in n).
    """
    share = 1 - (ALPHA / 2) ** (1 / rows.shape[1])
    low, high = (end.clip(0, 1) for end in student(rows, rng))
    mean = rows.mean(1)
    return np.minimum(low, mean * (1 - share)), np.maximum(high, mean + share * (1 - mean))


def order(rows: Array, rng: np.random.Generator) -> Ends:
    """The report's interval of the median."""
    return median_of(rows.T)[1:]


METHODS: dict[str, tuple[Callable[[Array, np.random.Generator], Ends], Callable[[Array], Any]]] = {
    "mean: Student": (student, np.mean),
    "mean: bootstrap-t": (bootstrap_t, np.mean),
    "mean: Student and unseen runs": (unseen, np.mean),
    "median: the report's": (order, np.median),
}


def simulate(replications: int, seed: int = 0) -> pd.DataFrame:
    """How often each interval holds its mean or median, and how wide it is.

    Args:
        replications: of each law and number of seeds.
        seed: of all draws.

    Returns:
        A row for each law, number of ``seeds`` and method: ``coverage``, and median ``width`` in
        standard deviations of the law. None for an interval that needs bounds where a law has
        none.
    """
    rng = np.random.default_rng(seed)
    found = []
    for law, draw in LAWS.items():
        whole = draw(rng, (TRUTH,))
        for seeds in SEEDS:
            rows = draw(rng, (replications, seeds))
            for method, (interval, statistic) in METHODS.items():
                if interval is unseen and not 0 <= whole.min() <= whole.max() <= 1:
                    continue
                low, high = interval(rows, rng)
                truth = statistic(whole)
                held = np.mean((low <= truth) & (truth <= high))
                width = np.median(high - low) / whole.std()
                found.append((law, seeds, method, float(held), float(width)))
    return pd.DataFrame(found, columns=["law", "seeds", "method", "coverage", "width"])


def page(found: pd.DataFrame, replications: int, seed: int) -> str:
    """The table in Markdown, with what follows from it."""
    found["cell"] = [f"{row.coverage:.3f} ({row.width:.1f})" for row in found.itertuples()]
    cells = found.pivot(index=["law", "seeds"], columns="method", values="cell").fillna("–")
    table = cells.reindex(
        index=dict.fromkeys(zip(found.law, found.seeds, strict=True)), columns=list(METHODS)
    )
    lines = ["| law of the runs | seeds | " + " | ".join(METHODS) + " |", "|---" * 6 + "|"]
    for (law, seeds), row in zip(table.index, table.to_numpy(), strict=True):
        lines.append(f"| {law} | {seeds} | {' | '.join(row)} |")
    standard = (HELD * (1 - HELD) / replications) ** 0.5
    return "\n".join(
        [
            "# What an interval over seeds promises",
            "",
            f"Of {replications:,} studies with 5 and 10 seeds, the share whose interval holds the "
            "law's mean or median, and its median width in standard deviations of the law. A share "
            f"has a standard error of {standard:.3f} or less. Drawn by `bin/research intervals "
            f"--replications {replications} --seed {seed} -o results/intervals.md`.",
            "",
            *lines,
            "",
            "The report gives **medians over seeds**. Its interval, from the k-th lowest to the "
            f"k-th highest run, holds the median of such runs with a probability of {HELD:.0%} at "
            "least, whatever the law (0.9375 with 5 seeds, 0.979 with 10): a theorem that the "
            "simulation checks.",
            "",
            "A mean over so few seeds cannot have such an interval at a useful width. Where one "
            f"run in five fails, {1 - FAILING:.1f}⁵ = {(1 - FAILING) ** 5:.0%} of studies with "
            "five seeds show no failure, and look exactly as studies of a method that never fails. "
            "Whoever wants to be wrong in a tenth of them at most must reach down to 0.8 of the "
            "mean in most of those, so also where nothing fails; the bound on unseen runs does it, "
            "and is several times as wide where runs agree. Student's interval and the bootstrap "
            "see what was drawn alone.",
            "",
            "So the interval of a median says nothing of failures that are rarer than one in two: "
            "the tables count the runs that reached the threshold, and charts have a dot for each. "
            "Differences and verdicts are of means, by Student's or Welch's test, whose share of "
            "false verdicts stays below its bound for laws such as these "
            "(`tests/report/test_coverage.py`).",
            "",
        ]
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point; the exit codes are those of :mod:`proposer_rl.cli.errors`."""
    command(partial(_answer, _parser().parse_args(arguments)))


def _answer(options: argparse.Namespace) -> None:
    text = page(simulate(options.replications, options.seed), options.replications, options.seed)
    print(text)
    if options.output is not None:
        write_atomically(options.output, text.encode())


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bin/research intervals", description=__doc__)
    parser.add_argument(
        "--replications", type=number(int, 1), default=10_000, help="studies of each kind (10000)"
    )
    parser.add_argument("--seed", type=number(int, 0), default=0, help="of all draws (0)")
    parser.add_argument("-o", "--output", type=Path, help="a file for the page as well")
    return parser


if __name__ == "__main__":
    main()

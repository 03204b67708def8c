"""PPO as it is practised, beside Stable-Baselines3's: returns, and processor seconds per frame.

Both train without a curriculum, with the numbers that our tasks have and those of
rl-baselines3-zoo. Of ours all seeds train side by side; of theirs one after another. Every run is a
row of a table, which is gone on with: what is in it is not trained again.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import Any, NamedTuple

import pandas as pd
from omegaconf import OmegaConf

from proposer_rl.cli.build import parts
from proposer_rl.cli.config import RunConfig, read_config
from proposer_rl.experiment.continued import ContinuedLevels
from proposer_rl.experiment.loop import SideBySide
from proposer_rl.recipes import CONFIG_FOLDER, composed
from proposer_rl.runs.folder import write_atomically
from proposer_rl.runs.process import StopSignals
from proposer_rl.streams import Streams
from research.benchmarks.results import Options, Result, Row, Spread, Table
from research.benchmarks.sb3_peer import train_sb3
from research.benchmarks.timing import threads

EPISODES = 50  # of an evaluation, with the most probable actions


class Plain(NamedTuple):
    """An environment without a curriculum.

    Attributes:
        frames: to train for.
        parameter: of the only level but for its seed: a number as the environment has it anyway.
        numbers: the file of ``conf/task`` that has PPO's numbers, or these.
    """

    frames: int
    parameter: dict[str, Any]
    numbers: str | dict[str, Any]


ENVIRONMENTS = {
    "CartPole-v1": Plain(100_000, {"gravity": {"values": [9.8], "target": 9.8}}, "cartpole"),
    "LunarLander-v3": Plain(
        200_000, {"gravity": {"values": [-10.0], "target": -10.0}}, "lunar_lander"
    ),
    "BipedalWalker-v3": Plain(
        500_000,
        {"hardcore": {"values": [0], "target": 0}},
        {
            "batch_size": 32,
            "ppo": {
                "horizon": 2048,
                "normalize_observations": True,
                "normalize_rewards": True,
                "minibatches": 1024,
                "epochs": 10,
                "learning_rate": 3e-4,
                "anneal_updates": None,
                "gamma": 0.999,
                "clip_epsilon": 0.18,
                "entropy_coeff": 0.0,
                "critic_coeff": 0.5,
                "clip_value": None,
            },
        },
    ),
}
OURS, THEIRS = "proposer_rl", "stable_baselines3"


class Trained(NamedTuple):
    """A row: one Solver after its training.

    Attributes:
        code: ``"proposer_rl"`` or ``"stable_baselines3"``.
        environment, seed: of the run.
        frames: trained for.
        cpu_seconds: of the processors in training; of Solvers side by side each has its share.
        mean_return, least_return: of the evaluation's episodes.
    """

    code: str
    environment: str
    seed: int
    frames: int
    cpu_seconds: float
    mean_return: float
    least_return: float


def against_sb3(options: Options) -> Result:
    """Train what is missing in ``options.rows``, and compare."""
    names = list(options.environments or ENVIRONMENTS)
    seeds = list(options.seeds)
    if options.tiny:
        names, seeds = names[:1], seeds[:2]
    file = Path(options.rows) if options.rows else None
    rows = read_rows(file)
    with threads(1):
        for name in names:
            for made in _missing(name, seeds, rows, options):
                rows += made
                if file is not None:
                    write_rows(file, rows)
    return _compared([row for row in rows if row.environment in names and row.seed in seeds])


def train_ours(environment: str, seeds: Sequence[int], frames: int, episodes: int) -> list[Trained]:
    """Train Solvers of these seeds side by side on an environment's one level, and evaluate."""
    config = _config(environment, seeds, frames, episodes)
    made = parts(config, StopSignals())
    sides = SideBySide(made.task, made.learner, made.curricula)
    like = made.task.evaluated_on["target"][0]
    levels = ContinuedLevels(made.curricula, sides.students, made.learner, like)
    started = time.process_time()
    for update in range(config.schedule.updates):
        _, credits = levels.update([Streams(seed, "update", update) for seed in seeds])
        sides.observe(credits)
    cpu = (time.process_time() - started) / len(seeds)
    returns = made.task.evaluate(made.learner.agent)["target"]["return"]
    each = config.schedule.updates * config.solver.batch_size * config.solver.ppo.horizon
    return [
        Trained(OURS, environment, seed, each, cpu, float(own.mean()), float(own.min()))
        for seed, own in zip(seeds, returns, strict=True)
    ]


def read_rows(file: Path | None) -> list[Trained]:
    """The rows of a table; none where there is no such file."""
    if file is None or not file.exists():
        return []
    return [Trained(*row) for row in pd.read_csv(file).itertuples(index=False)]


def write_rows(file: Path, rows: Sequence[Trained]) -> None:
    """Write the table anew."""
    write_atomically(file, pd.DataFrame(rows).to_csv(index=False, lineterminator="\n").encode())


def _missing(
    name: str, seeds: Sequence[int], rows: Sequence[Trained], options: Options
) -> Iterator[list[Trained]]:
    frames, episodes = ENVIRONMENTS[name].frames, EPISODES
    if options.tiny:
        frames, episodes = 512, 2
    done = {(row.code, row.seed) for row in rows if row.environment == name}
    ours = [seed for seed in seeds if (OURS, seed) not in done]
    if ours:
        yield train_ours(name, ours, frames, episodes)
    for seed in seeds:
        if (THEIRS, seed) not in done:
            yield [Trained(THEIRS, name, seed, *train_sb3(name, seed, frames, episodes))]


def _config(environment: str, seeds: Sequence[int], frames: int, episodes: int) -> RunConfig:
    _, parameter, numbers = ENVIRONMENTS[environment]
    if isinstance(numbers, str):
        conf: Any = OmegaConf.load(CONFIG_FOLDER / "task" / f"{numbers}.yaml")
        numbers = OmegaConf.to_container(conf.solver)  # type: ignore[assignment]
    solver: Any = numbers
    count = solver.get("batch_size", 8)
    task = {
        "env_id": environment,
        "parameters": parameter,
        "success": {"kind": "return", "least": 0.0},
        "evaluation": {"levels": episodes, "actions": "most_probable"},
    }
    updates = -(-frames // (count * solver["ppo"]["horizon"]))
    own = {"task": task, "solver": {"batch_size": count, "ppo": solver["ppo"]}}
    more = {"seeds": [*seeds], "schedule": {"updates": updates}}
    return read_config(composed(["task=gymnasium", "method=target"], own, more))


def _compared(rows: Sequence[Trained]) -> Result:
    lines, costs = [], []
    for name in dict.fromkeys(row.environment for row in rows):
        runs = {code: [r for r in rows if (r.environment, r.code) == (name, code)]
                for code in (OURS, THEIRS)}  # fmt: skip
        for code, own in runs.items():
            returns = [run.mean_return for run in own]
            spread = f" ± {stdev(returns):.1f}" if len(returns) > 1 else ""
            cost = mean(run.cpu_seconds / run.frames for run in own)
            lines.append(
                [
                    name,
                    code,
                    f"{len(own)}",
                    f"{mean(run.frames for run in own):,.0f}",
                    f"{mean(returns):.1f}{spread}",
                    f"{min(returns):.1f}",
                    f"{1e6 * cost:.0f}",
                ]
            )
        theirs = mean(run.cpu_seconds / run.frames for run in runs[THEIRS])
        ratios = [run.cpu_seconds / run.frames / theirs for run in runs[OURS]]
        what = f"processor seconds of a frame, {name}"
        costs.append(
            Row(what, "Stable-Baselines3's", Spread.of(ratios), "x", target=1.0, at_most=True)
        )
    header = ["environment", "code", "seeds", "frames", "return ± deviation", "least", "µs a frame"]
    note = f"Returns are means of {EPISODES} episodes of each seed, with the most probable actions."
    return Result(costs, [Table("Trained without a curriculum", header, lines)], [note])

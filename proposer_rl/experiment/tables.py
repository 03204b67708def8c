"""Writes the tables of an experiment into its folder, and passes rows to a logger."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from proposer_rl.runs.folder import RunFolder, read_table
from proposer_rl.task import Levels, Task

Log = Callable[[str, Mapping[str, Any], int], None]
"""A function that receives each row of the first Solver: its table, its values and its update."""

RECORDED_LEVELS = 8
LOGGED = ("metrics.csv", "training.csv", "cycles.jsonl")  # of numbers


class RunTables:
    """Writes the tables of K Solvers that train side by side."""

    def __init__(
        self, task: Task, seeds: Sequence[int], folder: RunFolder, log: Log | None
    ) -> None:
        self._task, self._seeds, self._folder = task, seeds, folder
        self._log = log or (lambda table, values, updates: None)

    def add_metrics(
        self, updates: int, measured: TensorDictBase, costs: Sequence[Mapping[str, float]]
    ) -> None:
        """Writes a row for each of K Solvers: its measurements, [K], and its costs so far."""
        for (seed, values), spent in zip(self._per_copy(measured), costs, strict=True):
            self._append("metrics.csv", {"seed": seed, "updates": updates, **spent, **values})

    def add_levels(self, updates: int, reached: Mapping[str, TensorDictBase]) -> None:
        """Writes each Solver's results on each evaluation level, [K, E] by distribution."""
        for name, performance in reached.items():
            for copy, seed in enumerate(self._seeds):
                values = {str(key): value[copy].tolist() for key, value in performance.items()}
                row = {"seed": seed, "updates": updates, "distribution": name, **values}
                self._folder.append("levels.jsonl", row)

    def add_training(
        self, updates: int, played: Sequence[tuple[Levels, TensorDictBase]], metrics: TensorDictBase
    ) -> None:
        """Writes each Solver's metrics of an update, and a sample of its levels.

        Args:
            updates: so far.
            played: of each Solver levels [n] and a rollout [n, T] on them.
            metrics: PPO's, [K].
        """
        numbers = [
            self._task.training_metrics(levels.unsqueeze(0), rollout.unsqueeze(0))
            for levels, rollout in played
        ]
        for seed, values in self._per_copy(torch.cat(numbers), metrics):
            self._append("training.csv", {"seed": seed, "updates": updates, **values})
        some = slice(RECORDED_LEVELS)
        for seed, (levels, rollout) in zip(self._seeds, played, strict=True):
            sample = self._task.record(levels[some], rollout[some])
            row = {"updates": updates, "seed": seed, "levels": sample}
            self._folder.append("curriculum.jsonl", row)

    def add_cycle(
        self,
        updates: int,
        cycle: int,
        logs: Sequence[Mapping[str, Any]],
        costs: Sequence[Mapping[str, float]],
    ) -> None:
        """Writes each curriculum's log of the last cycle."""
        for seed, log, spent in zip(self._seeds, logs, costs, strict=True):
            place: dict[str, Any] = {"cycle": cycle, "updates": updates}
            if len(self._seeds) > 1:
                place["seed"] = seed
            asked = {name: spent[name] for name in ("curriculum_frames", "evaluations")}
            self._append("cycles.jsonl", {**place, **asked, **log})

    def log_again(self, updates: int) -> None:
        """Logs again the rows of the update from which a resumed run goes on.

        A logger then drops what it has of later updates.

        Raises:
            ValueError: naming the file and its line, if a table cannot be read.
        """
        files = [self._folder.path / name for name in LOGGED if name in self._folder.lengths()]
        rows = [(file.name, row) for file in files for row in read_table(file)]
        for table, row in rows:
            if row["updates"] == updates:
                self._tell(table, row)

    def _append(self, table: str, row: Mapping[str, Any]) -> None:
        self._folder.append(table, row)
        self._tell(table, row)

    def _tell(self, table: str, row: Mapping[str, Any]) -> None:
        if row.get("seed", self._seeds[0]) == self._seeds[0]:
            self._log(Path(table).stem, row, row["updates"])

    def _per_copy(self, *told: TensorDictBase) -> Iterator[tuple[int, dict[str, float]]]:
        for copy, seed in enumerate(self._seeds):
            entries = (entry for values in told for entry in values[copy].items())
            yield seed, {str(key): float(value) for key, value in entries}

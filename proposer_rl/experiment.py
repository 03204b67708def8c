"""The outer loop: a Solver, a curriculum and a budget become a folder of measurements."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge, Gt, Interval
from tensordict import TensorDict, TensorDictBase
from tqdm import tqdm

from proposer_rl.curricula import Curriculum
from proposer_rl.learning.divergence import located
from proposer_rl.learning.ppo import PPO, Update
from proposer_rl.models import ActorCritic
from proposer_rl.runs.checkpoint import CheckpointError, State, load_latest, save_checkpoint
from proposer_rl.runs.folder import RunFolder, read_csv
from proposer_rl.runs.signals import StopSignals
from proposer_rl.settings import settings
from proposer_rl.streams import Streams

Evaluate = Callable[[ActorCritic], TensorDictBase]
Statistics = Callable[[Any, TensorDictBase], TensorDictBase]
Records = Callable[[Any, TensorDictBase], list[list[dict[str, Any]]]]
Log = Callable[[str, Mapping[str, Any], int], None]


@settings
class Schedule:
    """How long a run is, and what happens how often; all in Solver updates.

    Attributes:
        updates: length of the run.
        cycle_length: updates between two improvements of the curriculum.
        evaluate_every: updates between two rows of metrics.
        checkpoint_every: updates between two checkpoints; one more follows every improvement.
        checkpoint_seconds: time after which a checkpoint is due, also in the middle of an
            improvement; None for no such limit.
        keep_checkpoints: how many of the newest checkpoints stay.
        headline: the measurement that the run is summed up by.
        threshold: sample efficiency is the first update at which the headline reaches this.
    """

    updates: Annotated[int, Ge(1)] = 750
    cycle_length: Annotated[int, Ge(1)] = 50
    evaluate_every: Annotated[int, Ge(1)] = 10
    checkpoint_every: Annotated[int, Ge(1)] = 50
    checkpoint_seconds: Annotated[float, Gt(0)] | None = 600.0
    keep_checkpoints: Annotated[int, Ge(1)] = 2
    headline: str = "id_success"
    threshold: Annotated[float, Interval(gt=0, le=1)] = 0.8


class Experiment:
    """The loop over cycles of improving the curriculum and training the Solver on it.

    Args:
        solver: a population of K Solvers, one per seed.
        curriculum: what they train on.
        schedule: lengths and intervals.
        seeds: the K seeds; every draw of copy k is a function of the k-th.
        folder: where the files go; a checkpoint in it is resumed.
        evaluate: measurements of the Solvers, each [K].
        statistics: of levels [K, P] and the rollout on them, each [K].
        records: of levels and the rollout on them: for each copy a list for JSON.
        log: receives each row of the first copy: its table, its values and its update.
        progress: whether to draw a progress bar.
        signals: which may ask the run to stop; None where nothing does.
        scope: put before the address of every random draw; tells several lives of one seed apart.
    """

    def __init__(
        self,
        solver: PPO,
        curriculum: Curriculum,
        *,
        schedule: Schedule,
        seeds: Sequence[int],
        folder: RunFolder,
        evaluate: Evaluate,
        statistics: Statistics,
        records: Records,
        log: Log | None = None,
        progress: bool = True,
        signals: StopSignals | None = None,
        scope: Sequence[str | int] = (),
    ) -> None:
        self.solver = solver
        self.curriculum = curriculum
        self.schedule = schedule
        self.seeds = list(seeds)
        self.folder = folder
        self.updates = 0
        self.cycles = 0
        self.meta_frames = 0
        self._evaluate = evaluate
        self._statistics = statistics
        self._records = records
        self._log = log
        self._progress = progress
        self._signals = signals or StopSignals()
        self._scope = tuple(scope)
        self._headline: list[float] = []
        self._checkpoints = 0
        self._seconds_before = 0.0
        self._started = self._saved = time.monotonic()

    @property
    def seconds(self) -> float:
        """Wall time of the run, that of its interrupted parts included up to their checkpoints."""
        return self._seconds_before + time.monotonic() - self._started

    @property
    def frames(self) -> int:
        """Environment steps of one Solver's own training."""
        problems = self.solver.env.batch_size[1:].numel()
        return self.updates * problems * self.solver.settings.horizon

    def run(self) -> dict[str, Any]:
        """Train to the end of the schedule, from the folder's newest checkpoint if it has one.

        Returns:
            The summary of the run, ready for JSON.

        Raises:
            CheckpointError: if the folder's checkpoint is unusable or another experiment's.
            DivergedError: if a number is not finite, saying where. The checkpoint before stays.
            Interrupted: if a signal asked the run to stop; all is saved then.
            StorageError: if the disk does not take a file.
        """
        if not self._resume():
            self._measure()
        bar = tqdm(
            total=self.schedule.updates,
            initial=self.updates,
            desc="Solver updates",
            disable=not self._progress,
            smoothing=0,
            # A file gets a line now and then, not thousands.
            mininterval=0.1 if sys.stderr.isatty() else 30,
            dynamic_ncols=True,
        )
        with bar:
            while self.updates < self.schedule.updates:
                before = self.updates
                cycle = self.updates // self.schedule.cycle_length
                with located(f"cycle {cycle}, after {self.updates} Solver updates"):
                    if self.updates >= self.cycles * self.schedule.cycle_length:
                        self._improve()
                    else:
                        self._update()
                bar.set_postfix_str(self._headline_text(), refresh=False)
                bar.update(self.updates - before)
        return self.summary()

    def summary(self) -> dict[str, Any]:
        """Sample efficiency and cost so far, from the metrics in the folder."""
        rows = read_csv(self.folder.path / "metrics.csv")
        headline, threshold = self.schedule.headline, self.schedule.threshold
        reached = {
            seed: next(
                (
                    int(row["updates"])
                    for row in rows
                    if row["seed"] == seed and row[headline] >= threshold
                ),
                None,
            )
            for seed in self.seeds
        }
        return {
            "updates": self.updates,
            "frames": self.frames,
            "meta_frames": self.meta_frames,
            "seconds": self.seconds,
            "headline": headline,
            "threshold": threshold,
            # null: censored, the threshold was not reached within ``updates``
            "updates_to_threshold": [reached[seed] for seed in self.seeds],
            "final": [row for row in rows if row["updates"] == self.updates],
        }

    def _improve(self) -> None:
        streams = self._streams("cycle", self.cycles)
        outcome = self.curriculum.improve(self.solver, streams, self._pause)
        self.meta_frames += outcome.meta_frames
        if outcome.metrics:
            place = {"cycle": self.cycles, "updates": self.updates, "meta_frames": self.meta_frames}
            self.folder.append("proposer.jsonl", {**place, **outcome.metrics})
            self._tell("proposer", outcome.metrics)
        self.cycles += 1
        if outcome.advance is not None:
            self.updates = min(self.updates + outcome.advance.updates, self.schedule.updates)
            self._measure()
            self._record(outcome.advance.levels, outcome.advance.update)
        # Improving can be nearly all of a cycle's work, so it is saved at once.
        self._pause(due=bool(outcome.metrics))

    def _update(self) -> None:
        streams = self._streams("update", self.updates)
        levels = self.curriculum.propose(self.solver, streams)
        self.solver.env.set_levels(levels)
        device = self.solver.env.device
        update = self.solver.update(
            [stream.generator("actions", device=device) for stream in streams]
        )
        self.solver.check()
        self.curriculum.observe(levels, update.rollout)
        self.updates += 1
        last = self.updates == self.schedule.updates
        if last or self.updates % self.schedule.evaluate_every == 0:
            self._measure()
            self._record(levels, update)
        self._pause(due=last or self.updates % self.schedule.checkpoint_every == 0)

    def _measure(self) -> None:
        """Append a row of measurements for every copy."""
        measured = self._evaluate(self.solver.agent)
        cost = {
            "frames": self.frames,
            "meta_frames": self.meta_frames,
            "seconds": round(self.seconds, 3),
        }
        self._headline = measured[self.schedule.headline].tolist()
        for seed, values in self._per_copy(measured):
            self._append("metrics.csv", seed, {**cost, **values})

    def _record(self, levels: Any, update: Update) -> None:
        """Append how the training went and samples of its levels, for every copy."""
        training = {key: float(value) for key, value in update.metrics.items()}
        for seed, values in self._per_copy(self._statistics(levels, update.rollout)):
            self._append("training.csv", seed, {**values, **training})
        records = self._records(levels, update.rollout)
        for seed, sample in zip(self.seeds, records, strict=True):
            row = {"updates": self.updates, "seed": seed, "levels": sample}
            self.folder.append("curriculum.jsonl", row)
        self._tell("curriculum", {"levels": records[0]})

    def _append(self, table: str, seed: int, values: Mapping[str, float]) -> None:
        self.folder.append(table, {"seed": seed, "updates": self.updates, **values})
        if seed == self.seeds[0]:
            self._tell(Path(table).stem, values)

    def _tell(self, table: str, row: Mapping[str, Any]) -> None:
        if self._log is not None:
            self._log(table, row, self.updates)

    def _per_copy(self, values: TensorDictBase) -> Iterator[tuple[int, dict[str, float]]]:
        for copy, seed in enumerate(self.seeds):
            yield seed, {str(key): float(value) for key, value in values[copy].items()}

    def _streams(self, *scope: str | int) -> list[Streams]:
        return [Streams(seed, *self._scope, *scope) for seed in self.seeds]

    def _headline_text(self) -> str:
        mean = sum(self._headline) / len(self._headline)
        return f"{self.schedule.headline} {mean:.3f}"

    def _pause(self, due: bool = False) -> None:
        """A safe point: save if it is due or the time has come, stop if a signal asked for it."""
        limit = self.schedule.checkpoint_seconds
        late = limit is not None and time.monotonic() - self._saved >= limit
        if due or late or self._signals.pending:
            self._save()
        self._signals.deliver()

    def _save(self) -> None:
        self._checkpoints += 1
        save_checkpoint(
            self.folder.path / "checkpoints",
            self._checkpoints,
            self._state(),
            self.schedule.keep_checkpoints,
        )
        self._saved = time.monotonic()

    def _state(self) -> State:
        return {
            "updates": self.updates,
            "cycles": self.cycles,
            "meta_frames": self.meta_frames,
            "seconds": self.seconds,
            "headline": self._headline,
            "rows": self.folder.lengths(),
            "solver": self.solver.snapshot().to_dict(),
            "curriculum": self.curriculum.state_dict(),
        }

    def _resume(self) -> bool:
        checkpoints = self.folder.path / "checkpoints"
        latest = load_latest(checkpoints)
        if latest is None:
            self.folder.cut_back({})
            return False
        self._checkpoints, state = latest
        try:
            self._set_state(state)
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            reason = " ".join(str(error).split())
            raise CheckpointError(
                f"checkpoint {self._checkpoints} in {checkpoints} does not fit this run: {reason}"
            ) from error
        return True

    def _set_state(self, state: State) -> None:
        self.solver.restore(TensorDict(state["solver"], [len(self.seeds)]))
        self.curriculum.load_state_dict(state["curriculum"])
        self.updates, self.cycles = state["updates"], state["cycles"]
        self.meta_frames = state["meta_frames"]
        self._seconds_before = state["seconds"]
        self._headline = state["headline"]
        self.folder.cut_back(state["rows"])

"""The outer loop: trains Solvers on curricula, and writes a folder of measurements."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Annotated, Any

import torch
from annotated_types import Ge, Gt
from tensordict import TensorDict
from tqdm import tqdm

from proposer_rl.curricula import (
    Batch,
    Curriculum,
    LearnedCurriculum,
    TaskStudent,
    outcome_of,
    require,
)
from proposer_rl.curricula.batches import saved
from proposer_rl.curricula.bins import along_axes
from proposer_rl.curricula.contract import proposed
from proposer_rl.experiment.continued import ContinuedLevels, Credit
from proposer_rl.experiment.tables import Log, RunTables
from proposer_rl.learning import PPO, located
from proposer_rl.runs.checkpoint import CheckpointError, State, load_latest, save_checkpoint
from proposer_rl.runs.folder import SLACK, RunFolder, can_reach, read_csv
from proposer_rl.runs.process import Output, Status, StopRequested, StopSignals
from proposer_rl.settings import ArgumentError, settings
from proposer_rl.streams import Streams
from proposer_rl.task import NoSuccessError, Task, nearest_bins
from proposer_rl.task.protocols import MANY_BINS


class Experiment:
    """Runs an experiment: improves the curricula in cycles, and trains Solvers on their levels.

    Args:
        task: measures and records the Solvers.
        learner: PPO of a population of K Solvers, one per seed.
        curricula: one for each Solver.
        schedule: lengths and intervals.
        seeds: the K seeds; every draw for Solver k is a function of the k-th.
        folder: for the files; a run with a checkpoint in it is resumed.
        log: receives each row of the first Solver: its table, its values and its update.
        progress: whether to draw a progress bar.
        signals: may ask the run to stop; None for no signals. A long improvement of a curriculum
            can be interrupted; see :meth:`StopSignals.check`.
        status: shows what the run is doing; a curriculum may report the parts of an improvement.

    Raises:
        UnfitStudentError: if the task does not allow what the curriculum needs.
        NoSuccessError: if the curriculum needs success and the task has none.
        ValueError: if the headline is not a metric of the task.
    """

    def __init__(
        self,
        task: Task,
        learner: PPO,
        curricula: Sequence[Curriculum],
        *,
        schedule: ScheduleSettings,
        seeds: Sequence[int],
        folder: RunFolder,
        log: Log | None = None,
        progress: bool = True,
        signals: StopSignals | None = None,
        status: Status | None = None,
    ) -> None:
        check_headline(task, schedule)
        self.task, self.learner = task, learner
        self.sides = SideBySide(task, learner, curricula)
        self._continued: ContinuedLevels | None = None
        if learner.settings.continue_episodes:
            like = next(iter(task.evaluated_on.values()))[0]
            self._continued = ContinuedLevels(curricula, self.sides.students, learner, like)
        self.schedule, self.seeds, self.folder = schedule, list(seeds), folder
        self.updates, self.cycles = 0, 0
        self._tables = RunTables(task, self.seeds, folder, log)
        self._progress = progress
        self._signals, self._status = signals or StopSignals(), status or Status()
        self._headline: list[float] = []
        self._checkpoints = 0
        self._seconds_before = 0.0
        self._started = self._saved = time.monotonic()

    @property
    def seconds(self) -> float:
        """Wall time of the run, including interrupted parts up to their checkpoints."""
        return self._seconds_before + time.monotonic() - self._started

    @property
    def costs(self) -> list[dict[str, float]]:
        """The costs of each Solver so far, by name.

        ``frames`` are environment steps of its own training. ``curriculum_frames`` and
        ``evaluations`` are environment steps and evaluated levels that its curriculum asked for.
        ``seconds`` are those of the process.
        """
        return [
            {
                "frames": self.updates * self.task.batch_size * self.learner.settings.horizon,
                "curriculum_frames": student.frames,
                "evaluations": student.evaluations,
                "seconds": round(self.seconds, 3),
            }
            for student in self.sides.students
        ]

    def run(self) -> dict[str, Any]:
        """Trains to the end of the schedule, from the folder's newest checkpoint if there is one.

        Returns:
            The summary of the run, ready for JSON.

        Raises:
            CheckpointError: if the folder's checkpoint is unusable or of another experiment.
            DivergedError: if a number is not finite, saying where. The last checkpoint stays.
            Interrupted: if a signal asked the run to stop, after saving.
            StorageError: if a file cannot be written.
        """
        resumed = self._resume()
        errors = Output(sys.stderr)
        bar = tqdm(
            total=self.schedule.updates,
            initial=self.updates,
            desc="Solver updates",
            file=errors,
            disable=not self._progress,
            smoothing=0,
            # A file gets a line now and then, not thousands.
            mininterval=0.1 if errors.isatty() else 30,
            dynamic_ncols=True,
        )

        def show() -> None:
            text = ", ".join(filter(None, [self._headline_text(), self._status.doing]))
            bar.set_postfix_str(text, refresh=errors.isatty())

        self._status.show = show
        with bar:
            if not resumed:
                self._measure()
            while self.updates < self.schedule.updates:
                before = self.updates
                cycle = self.updates // self.schedule.cycle_length
                with located(f"cycle {cycle}, after {self.updates} Solver updates"):
                    if self.updates >= self.cycles * self.schedule.cycle_length:
                        self._improve()
                    else:
                        self._update()
                bar.update(self.updates - before)
            bar.set_postfix_str(self._headline_text())
            self._log_cycle()  # after the last checkpoint, so a longer schedule writes it again
            self._measure_levels()
        return self.summary()

    def summary(self) -> dict[str, Any]:
        """Computes sample efficiency and cost so far from the metrics in the folder."""
        rows = read_csv(self.folder.path / "metrics.csv")
        headline, threshold = self.schedule.headline, self.schedule.threshold
        met = [row for row in rows if row[headline] >= threshold - SLACK]
        reached = [[int(row["updates"]) for row in met if row["seed"] == s] for s in self.seeds]
        return {
            "updates": self.updates,
            **{name: max(own[name] for own in self.costs) for name in self.costs[0]},
            "headline": headline,
            "threshold": threshold,
            # null: censored, the threshold was not reached within ``updates``
            "updates_to_threshold": [next(iter(updates), None) for updates in reached],
            "final": [row for row in rows if row["updates"] == self.updates],
        }

    def _improve(self) -> None:
        """Begins a cycle: improves the curricula, and logs the cycle before."""
        spent = [student.frames for student in self.sides.students]
        logged = self._log_cycle(self._improved())
        self.cycles += 1
        # Improving can be most of the work of a cycle, so it is saved at once.
        spends = spent != [student.frames for student in self.sides.students]
        self._pause(due=logged or spends)

    def _improved(self) -> list[dict[str, Any]]:
        streams = self._streams("cycle", self.cycles)
        if not any(isinstance(each, LearnedCurriculum) for each in self.sides.curricula):
            return [{} for _ in streams]
        while True:
            before = deepcopy(self._state())  # improving may change the state in place
            try:
                self._status.tell("improving the curriculum")
                return self.sides.improve(streams)
            except StopRequested:
                self._save(before)
                self._signals.deliver()
                # The signal was handled and the run goes on.
                self._restore(before)

    def _log_cycle(self, improved: Sequence[Mapping[str, Any]] | None = None) -> bool:
        """Writes the logs of the cycle that has ended, and metrics of its improvement.

        Each has the histogram of the levels trained on, unless the curriculum logs its own.

        Returns:
            Whether a curriculum logged something or was improved.
        """
        logs = [curriculum.log() for curriculum in self.sides.curricula]
        metrics = [
            {**log, **own} for log, own in zip(logs, improved or [{}] * len(logs), strict=True)
        ]
        rows = self.sides.with_histograms(metrics)
        if any(rows):
            self._tables.add_cycle(self.updates, self.cycles, rows, self.costs)
        return any(metrics)

    def _update(self) -> None:
        streams = self._streams("update", self.updates)
        self._status.tell("training the Solver")
        if self._continued is not None:
            update, credits = self._continued.update(streams)
            played = self._continued.shown
        else:
            batches = self.sides.propose(self.task.batch_size, streams)
            self.learner.env.set_levels(torch.stack([batch.levels for batch in batches]))
            update = self.learner.update([stream.generator("actions") for stream in streams])
            self.learner.check()
            own = list(zip(batches, update.rollout.unbind(0), strict=True))
            credits = [[(batch, outcome_of(rollout))] for batch, rollout in own]
            played = [(batch.levels, rollout) for batch, rollout in own]
        self.sides.observe(credits)
        self.updates += 1
        last = self.updates == self.schedule.updates
        if last or self.updates % self.schedule.evaluate_every == 0:
            self._measure()
            self._tables.add_training(self.updates, played, update.metrics)
        self._pause(due=last or self.updates % self.schedule.checkpoint_every == 0)

    def _measure(self) -> None:
        self._status.tell("measuring")
        measured = self.task.measure(self.learner.agent)
        self._headline = measured[self.schedule.headline].tolist()
        self._tables.add_metrics(self.updates, measured, self.costs)

    def _measure_levels(self) -> None:
        self._tables.add_levels(self.updates, self.task.evaluate(self.learner.agent))

    def _streams(self, *scope: str | int) -> list[Streams]:
        return [Streams(seed, *scope) for seed in self.seeds]

    def _headline_text(self) -> str:
        if not self._headline:
            return ""
        mean = sum(self._headline) / len(self._headline)
        return f"{self.schedule.headline} {mean:.3f}"

    def _pause(self, due: bool) -> None:
        """Saves if a checkpoint is due or a signal came, and then obeys the signal."""
        limit = self.schedule.checkpoint_seconds
        late = limit is not None and time.monotonic() - self._saved >= limit
        if due or late or self._signals.pending:
            self._save(self._state())
        self._signals.deliver()

    def _save(self, state: State) -> None:
        self._checkpoints += 1
        folder, keep = self.folder.path / "checkpoints", self.schedule.keep_checkpoints
        save_checkpoint(folder, self._checkpoints, state, keep)
        self._saved = time.monotonic()

    def _state(self) -> State:
        return {
            "updates": self.updates,
            "cycles": self.cycles,
            "seconds": self.seconds,
            "headline": self._headline,
            "rows": self.folder.lengths(),
            "solver": self.learner.snapshot().to_dict(),
            **self.sides.state_dict(),
            **({} if self._continued is None else {"episodes": self._continued.state_dict()}),
        }

    def _resume(self) -> bool:
        checkpoints = self.folder.path / "checkpoints"
        latest = load_latest(checkpoints)
        if latest is None:
            self.folder.cut_back({})
            return False
        self._checkpoints, state = latest
        try:
            self._restore(state)
            self.folder.cut_back(state["rows"])
            self._tables.log_again(self.updates)
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            reason = " ".join(str(error).split())
            raise CheckpointError(
                f"checkpoint {self._checkpoints} in {checkpoints} does not fit this run: {reason}"
            ) from error
        return True

    def _restore(self, state: State) -> None:
        self.learner.restore(TensorDict(state["solver"], [len(self.seeds)]))
        self.sides.load_state_dict(state)
        if self._continued is not None:
            self._continued.load_state_dict(state["episodes"])
        self.updates, self.cycles = state["updates"], state["cycles"]
        self._seconds_before = state["seconds"]
        self._started = time.monotonic()
        self._headline = [float(value) for value in state["headline"]]


class SideBySide:
    """K curricula, each with its view of one of the K Solvers that train side by side.

    Args:
        task: of the students.
        learner: of K Solvers.
        curricula: one for each of them.

    Raises:
        UnfitStudentError: if the task does not allow what a curriculum needs.
        NoSuccessError: if a curriculum needs success and the task has none.
    """

    def __init__(self, task: Task, learner: PPO, curricula: Sequence[Curriculum]) -> None:
        self.curricula = list(curricula)
        self.students = [TaskStudent(task, learner, k) for k in range(len(curricula))]
        self._space = task.space
        known = hasattr(task.space, "locate") and bool(task.space.axes)
        none_yet = torch.zeros(task.space.size, dtype=torch.int64)
        counted = known and task.space.size <= MANY_BINS
        # Levels of each bin, int64 [N]; None if the curriculum logs its own.
        self._counts = [none_yet.clone() if counted else None for _ in curricula]
        for student, curriculum in zip(self.students, self.curricula, strict=True):
            require(student, curriculum.needs, type(curriculum).__name__)
            if "success" in curriculum.required_results and "success" not in task.results:
                raise NoSuccessError(
                    f"{type(curriculum).__name__}: reads success of episodes, and this task tells "
                    "none, only the return"
                )

    def propose(self, count: int, rngs: Sequence[Streams]) -> list[Batch]:
        """Lets each curriculum propose ``count`` levels from its own streams."""
        each = zip(self.curricula, self.students, rngs, strict=True)
        return [proposed(curriculum, student, count, rng) for curriculum, student, rng in each]

    def observe(self, credits: Sequence[Sequence[Credit]]) -> None:
        """Lets each curriculum observe its batches, or parts of them."""
        each = zip(self.curricula, self.students, credits, self._counts, strict=True)
        for curriculum, student, own, counts in each:
            for batch, outcome in own:
                curriculum.observe(student, batch, outcome)
                if counts is not None:
                    bins = nearest_bins(self._space, self._space.locate(batch.levels))
                    counts += bins.bincount(minlength=len(counts))

    def with_histograms(self, logs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
        """Adds to each curriculum's log how many levels it has observed near each bin since then.

        That is ``histogram`` along the axes of the task's space, unless the curriculum logs its
        own, or there are no bins to tell levels by, or too many of them.
        """
        rows = []
        for k, log in enumerate(logs):
            if "histogram" in log:
                self._counts[k] = None
            counts = self._counts[k]
            if counts is not None and counts.any():
                log = {"histogram": along_axes(counts, self._space), **log}
                self._counts[k] = torch.zeros_like(counts)
            rows.append(log)
        return rows

    def improve(self, rngs: Sequence[Streams]) -> list[dict[str, Any]]:
        """Improves the curricula that learn, and returns the metrics of each."""
        return [
            curriculum.improve(student, rng) if isinstance(curriculum, LearnedCurriculum) else {}
            for curriculum, student, rng in zip(self.curricula, self.students, rngs, strict=True)
        ]

    def state_dict(self) -> dict[str, Any]:
        """Returns the states of the curricula, the counters of their students, and histograms."""
        return {
            "counts": saved(self._counts),
            "curricula": [curriculum.state_dict() for curriculum in self.curricula],
            "asked": [[student.frames, student.evaluations] for student in self.students],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        self._counts = saved(state["counts"])
        for curriculum, own in zip(self.curricula, state["curricula"], strict=True):
            curriculum.load_state_dict(own)
        for student, (frames, evaluations) in zip(self.students, state["asked"], strict=True):
            student.frames, student.evaluations = frames, evaluations


@settings
class ScheduleSettings:
    """Settings of the length of a run and of its intervals, in Solver updates.

    Attributes:
        updates: length of the run.
        cycle_length: number of updates between two improvements of the curriculum.
        evaluate_every: number of updates between two rows of metrics.
        checkpoint_every: number of updates between two checkpoints; another follows every
            improvement.
        checkpoint_seconds: time after which the next update also saves a checkpoint; None for no
            limit.
        keep_checkpoints: number of newest checkpoints to keep.
        headline: the metric that sums up the run.
        threshold: sample efficiency is the first update at which the headline reaches this.
    """

    updates: Annotated[int, Ge(1)] = 750
    cycle_length: Annotated[int, Ge(1)] = 50
    evaluate_every: Annotated[int, Ge(1)] = 10
    checkpoint_every: Annotated[int, Ge(1)] = 50
    checkpoint_seconds: Annotated[float, Gt(0)] | None = 600.0
    keep_checkpoints: Annotated[int, Ge(1)] = 2
    headline: str = "id_success"
    threshold: float = 0.8


def check_headline(task: Task, schedule: ScheduleSettings) -> None:
    """Refuses a headline that is not measured, or a threshold that it cannot reach.

    Raises:
        ArgumentError: if the headline is not a metric of the task, or is a rate that cannot reach
            the threshold.
    """
    headline, threshold, known = schedule.headline, schedule.threshold, list(task.metrics)
    if headline not in known:
        raise ArgumentError(f"headline={headline!r}: must be one of {known}")
    if not can_reach(headline, threshold):
        raise ArgumentError(
            f"threshold={threshold:g}: must be above 0 and at most 1, as {headline} is"
        )

"""The curricula of Solvers that are trained side by side, one for each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from proposer_rl.curricula import Batch, Curriculum, LearnedCurriculum, TaskStudent, require
from proposer_rl.curricula.batches import saved
from proposer_rl.curricula.bins import along_axes
from proposer_rl.curricula.contract import proposed
from proposer_rl.experiment.continued import Credit
from proposer_rl.learning import PPO
from proposer_rl.streams import Streams
from proposer_rl.task import NoSuccessError, Task, nearest_bins
from proposer_rl.task.protocols import MANY_BINS


class SideBySide:
    """K curricula, and K views of the students that they propose to.

    Args:
        task: of the students.
        learner: of K Solvers.
        curricula: one for each of them.

    Raises:
        UnfitStudentError: if the task does not allow what a curriculum needs.
        NoSuccessError: if a curriculum reads success and the task has none.
    """

    def __init__(self, task: Task, learner: PPO, curricula: Sequence[Curriculum]) -> None:
        self.curricula = list(curricula)
        self.students = [TaskStudent(task, learner, k) for k in range(len(curricula))]
        self._space = task.space
        known = hasattr(task.space, "locate") and bool(task.space.axes)
        none_yet = torch.zeros(task.space.size, dtype=torch.int64)
        counted = known and task.space.size <= MANY_BINS
        # Levels of each bin, int64 [N]; None where the curriculum itself tells of them.
        self._counts = [none_yet.clone() if counted else None for _ in curricula]
        for student, curriculum in zip(self.students, self.curricula, strict=True):
            require(student, curriculum.needs, type(curriculum).__name__)
            if "success" in curriculum.required_results and "success" not in task.results:
                raise NoSuccessError(
                    f"{type(curriculum).__name__}: reads success of episodes, and this task tells "
                    "none, only the return"
                )

    def propose(self, count: int, rngs: Sequence[Streams]) -> list[Batch]:
        """Lets each curriculum propose ``count`` levels from streams of its own."""
        each = zip(self.curricula, self.students, rngs, strict=True)
        return [proposed(curriculum, student, count, rng) for curriculum, student, rng in each]

    def observe(self, credits: Sequence[Sequence[Credit]]) -> None:
        """Lets each curriculum observe its batches, or parts of some."""
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
        """Returns the curricula's states, what each asked of its student, and counts of levels."""
        return {
            "counts": saved(self._counts),
            "curricula": [curriculum.state_dict() for curriculum in self.curricula],
            "asked": [[student.frames, student.evaluations] for student in self.students],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Puts back what :meth:`state_dict` returned."""
        self._counts = saved(state["counts"])
        for curriculum, own in zip(self.curricula, state["curricula"], strict=True):
            curriculum.load_state_dict(own)
        for student, (frames, evaluations) in zip(self.students, state["asked"], strict=True):
            student.frames, student.evaluations = frames, evaluations

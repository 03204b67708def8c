"""The curricula of Solvers that are trained side by side, one for each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from proposer_rl.curricula import Batch, Curriculum, LearnedCurriculum, TaskStudent, require
from proposer_rl.curricula.contract import proposed
from proposer_rl.experiment.continued import Credit
from proposer_rl.learning import PPO
from proposer_rl.streams import Streams
from proposer_rl.task import NoSuccessError, Task


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
        for curriculum, student, own in zip(self.curricula, self.students, credits, strict=True):
            for batch, outcome in own:
                curriculum.observe(student, batch, outcome)

    def improve(self, rngs: Sequence[Streams]) -> list[dict[str, Any]]:
        """Improves the curricula that learn, and returns the metrics of each."""
        return [
            curriculum.improve(student, rng) if isinstance(curriculum, LearnedCurriculum) else {}
            for curriculum, student, rng in zip(self.curricula, self.students, rngs, strict=True)
        ]

    def state_dict(self) -> dict[str, Any]:
        """Returns the curricula's states, and what each asked of its student."""
        return {
            "curricula": [curriculum.state_dict() for curriculum in self.curricula],
            "asked": [[student.frames, student.evaluations] for student in self.students],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Puts back what :meth:`state_dict` returned."""
        for curriculum, own in zip(self.curricula, state["curricula"], strict=True):
            curriculum.load_state_dict(own)
        for student, (frames, evaluations) in zip(self.students, state["asked"], strict=True):
            student.frames, student.evaluations = frames, evaluations

"""A curriculum of tasks in prime-rl, whose ``Curriculum`` asks a sampler for the next one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from proposer_rl.settings import ArgumentError
from proposer_rl.teaching.sampler import TeacherSampler
from proposer_rl.teaching.teacher import Teacher


class TaughtTasks:
    """A ``TaskSampler`` of prime-rl that a teacher is behind.

        curriculum = train_source.curricula["math"]
        curriculum.sampler = TaughtTasks(teacher, tasks)

    Answers count that prime-rl's own samplers count: those of trainable agents, without errors.
    What is on its way when a checkpoint is saved is dropped when that is loaded, as prime-rl asks
    for other tasks then.

    Args:
        teacher: of :class:`~proposer_rl.teaching.Items`, one for each task.
        tasks: a finite set, each with a ``key`` of its own.
        sources: where each is from, [N], by which :meth:`metrics` are given, too; None for one.

    Raises:
        ArgumentError: if there are not as many tasks as items, or two of one key.
    """

    def __init__(
        self, teacher: Teacher, tasks: Sequence[Any], *, sources: Sequence[Any] | None = None
    ) -> None:
        self._sampler = TeacherSampler(teacher, 1, sources=sources)
        self._teacher, self._tasks = teacher, tasks
        self._places = {task.key: place for place, task in enumerate(tasks)}
        space: Any = teacher.space
        if len(tasks) != space.size:
            raise ArgumentError(f"tasks: are {len(tasks)}, the teacher has {space.size}")
        if len(self._places) < len(tasks):
            raise ArgumentError("tasks: must have a key each that no other has")

    def __iter__(self) -> TaughtTasks:
        return self

    def __next__(self) -> Any:
        """Returns the next task."""
        return self._tasks[next(iter(self._sampler))]

    def observe(self, group: Sequence[Any]) -> None:
        """Reports the episodes of a group, all on one task."""
        item = self._places[group[0].task.key]
        rewards = [
            trace.reward
            for episode in group
            for trace in episode.traces
            if episode.ok and not trace.has_error and trace.agent.trainable and trace.num_turns
        ]
        if rewards:
            mean = sum(rewards) / len(rewards)
            self._sampler.tell([item], [mean], episodes=[len(rewards)])
        else:
            self._sampler.drop([item])

    def state_dict(self) -> dict[str, Any]:
        """Returns the state of the curriculum."""
        return {"teacher": self._teacher.state_dict(), "sampler": self._sampler.state_dict()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Puts back a state, and drops what was out then."""
        self._teacher.load_state_dict(state_dict["teacher"])
        self._sampler.load_state_dict(state_dict["sampler"])
        self._sampler.drop()

    def metrics(self) -> dict[str, float]:
        """Returns :meth:`TeacherSampler.metrics`."""
        return self._sampler.metrics()

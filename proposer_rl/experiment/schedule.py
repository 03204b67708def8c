"""How long an experiment is, and what it is summed up by."""

from __future__ import annotations

from typing import Annotated

from annotated_types import Ge, Gt

from proposer_rl.runs.folder import can_reach
from proposer_rl.settings import ArgumentError, settings
from proposer_rl.task import Task


@settings
class ScheduleSettings:
    """How long a run is, and what happens how often; all in Solver updates.

    Attributes:
        updates: length of the run.
        cycle_length: updates between two improvements of the curriculum.
        evaluate_every: updates between two rows of metrics.
        checkpoint_every: updates between two checkpoints; one more follows every improvement.
        checkpoint_seconds: time after which a checkpoint is due at the next update; None for no
            such limit.
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
    threshold: float = 0.8


def check_headline(task: Task, schedule: ScheduleSettings) -> None:
    """Refuse to sum runs up by what is not measured, or not reached.

    Raises:
        ArgumentError: if the headline is none of the task's metrics, or a rate that is to reach
            what no rate can.
    """
    headline, threshold, known = schedule.headline, schedule.threshold, list(task.metrics)
    if headline not in known:
        raise ArgumentError(f"headline={headline!r}: must be one of {known}")
    if not can_reach(headline, threshold):
        raise ArgumentError(
            f"threshold={threshold:g}: must be above 0 and at most 1, as {headline} is"
        )

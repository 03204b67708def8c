"""Tasks: what they are made of, and the base of all."""

from proposer_rl.task.base import (
    Task,
    check_names,
    distribution_of,
    for_copies,
    named,
    refuse_single_bin,
)
from proposer_rl.task.contract import (
    ComputeContext,
    DifferentiableTask,
    Distribution,
    EditableTask,
    EnumerableTask,
    EpisodeLaw,
    LevelResult,
    Levels,
    LocatedTarget,
    NoSuccessError,
    OptimalTask,
    Space,
)
from proposer_rl.task.features import space_features

__all__ = [
    "ComputeContext",
    "DifferentiableTask",
    "Distribution",
    "EditableTask",
    "EnumerableTask",
    "EpisodeLaw",
    "LevelResult",
    "Levels",
    "LocatedTarget",
    "NoSuccessError",
    "OptimalTask",
    "Space",
    "Task",
    "check_names",
    "distribution_of",
    "for_copies",
    "named",
    "refuse_single_bin",
    "space_features",
]

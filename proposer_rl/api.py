"""Trains from Python, reads runs, and holds the public names of ``proposer_rl``."""

from __future__ import annotations

import json
import random
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from proposer_rl import curricula, tasks
from proposer_rl.curricula import (
    Batch,
    Curriculum,
    Filtered,
    LearnedCurriculum,
    Mixed,
    ProposerCurriculum,
    ProposerTrainer,
    SamplingCurriculum,
    Schedule,
    Student,
    TaskStudent,
    outcome_of,
)
from proposer_rl.experiment import Experiment, ScheduleSettings
from proposer_rl.learning import PPO, LeaveOneOutBaseline, PPOSettings, SolverSettings
from proposer_rl.meta.actions import Mixture, ProblemChoices
from proposer_rl.meta.env import SolverTrainingEnv, SolverView
from proposer_rl.meta.rewards import log_success_gain, performance_gain, task_difficulty
from proposer_rl.methods import filter_asked
from proposer_rl.models import (
    ActorCritic,
    MapEncoder,
    MixtureHead,
    Population,
    ProblemHead,
    ProposerNetwork,
    UNet,
)
from proposer_rl.recipes import DEFAULT_METHOD, Recipe, as_recipe
from proposer_rl.settings import ArgumentError, arguments
from proposer_rl.streams import Streams
from proposer_rl.task import ComputeContext, Task
from proposer_rl.tasks.mazes import Level, LevelSpec, MazeEnv, generate_levels, shortest_path_length
from proposer_rl.tasks.mazes.evaluation import ExactEvaluator, RolloutEvaluator
from proposer_rl.teaching import (
    Items,
    LevelGenerator,
    LevelTerm,
    LevelTransform,
    Log,
    MadeLevels,
    Parameters,
    TaughtEnv,
    TaughtRunner,
    Teacher,
    TeacherSampler,
)

if TYPE_CHECKING:
    import pandas as pd

    from proposer_rl.tasks.policy import Policy

__all__ = [
    "DEFAULT_METHOD",
    "PPO",
    "ActorCritic",
    "ArgumentError",
    "Batch",
    "ComputeContext",
    "Curriculum",
    "ExactEvaluator",
    "Experiment",
    "Filtered",
    "Items",
    "LearnedCurriculum",
    "LeaveOneOutBaseline",
    "Level",
    "LevelGenerator",
    "LevelSpec",
    "LevelTerm",
    "LevelTransform",
    "Log",
    "MadeLevels",
    "MapEncoder",
    "MazeEnv",
    "Mixed",
    "Mixture",
    "MixtureHead",
    "PPOSettings",
    "Parameters",
    "Population",
    "ProblemChoices",
    "ProblemHead",
    "ProposerCurriculum",
    "ProposerNetwork",
    "ProposerTrainer",
    "RolloutEvaluator",
    "Run",
    "SamplingCurriculum",
    "Schedule",
    "ScheduleSettings",
    "SolverSettings",
    "SolverTrainingEnv",
    "SolverView",
    "Streams",
    "Student",
    "Task",
    "TaskStudent",
    "TaughtEnv",
    "TaughtRunner",
    "Teacher",
    "TeacherSampler",
    "UNet",
    "curricula",
    "generate_levels",
    "log_success_gain",
    "outcome_of",
    "performance_gain",
    "shortest_path_length",
    "task_difficulty",
    "tasks",
    "train",
]


@dataclass(frozen=True)
class Run:
    """Reads a run's folder.

    Attributes:
        folder: the absolute path, which ``bin/watch``, ``bin/report``, ``bin/eval`` and
            ``bin/play`` also take.
    """

    folder: Path

    def __init__(self, folder: str | PathLike[str]) -> None:
        object.__setattr__(self, "folder", Path(folder).expanduser().absolute())

    @property
    def metrics(self) -> pd.DataFrame:
        """A row for each measurement of each Solver: updates, costs, success and return."""
        return self._table("metrics.csv")

    @property
    def training(self) -> pd.DataFrame:
        """A row for each measurement: features of the levels trained on, and PPO's numbers."""
        return self._table("training.csv")

    @property
    def summary(self) -> dict[str, Any]:
        """The last measurements, the costs, and when the run reached the threshold."""
        content: dict[str, Any] = json.loads((self.folder / "summary.json").read_bytes())
        return content

    @property
    def picture(self) -> Path:
        """The path of a PNG with learning curves and levels."""
        return self.folder / "run.png"

    def solver(self) -> ActorCritic:
        """Returns the trained Solvers of the newest checkpoint; see :meth:`ActorCritic.actor`."""
        return self._stored()[1]

    def policy(self, seed: int | None = None) -> Policy:
        """Returns one trained Solver for Gymnasium, TorchRL and ``torch.export``.

        Args:
            seed: of the Solver, in a run of several seeds; None for the first.
        """
        from proposer_rl.cli.stored import stored_run
        from proposer_rl.tasks.policy import policy_of

        run = stored_run(self.folder)
        chosen = run.config.seeds[0] if seed is None else seed
        return policy_of(run.task, run.stage(seeds=[chosen]).learner)

    def task(self) -> Task:
        """Returns the task that the run trained on."""
        return self._stored()[0]

    def _stored(self) -> tuple[Task, ActorCritic]:
        from proposer_rl.cli.stored import stored_run

        run = stored_run(self.folder)
        return run.task, run.stage().learner.agent

    def _table(self, name: str) -> pd.DataFrame:
        import pandas as pd

        return pd.read_csv(self.folder / name)


def train(
    task: Recipe | str,
    curriculum: Recipe | str = DEFAULT_METHOD,
    *,
    scale: str | None = None,
    filter: Mapping[str, Any] | str | None = None,
    updates: int | None = None,
    seed: int = 0,
    folder: str | Path | None = None,
    settings: Mapping[str, Any] | None = None,
    progress: bool = True,
) -> Run:
    """Trains a Solver on a task with a curriculum.

    The run is the same as that of ``bin/train`` with the same settings, bit for bit on one machine.
    Called again with the same folder, the function resumes a run that was interrupted.

    Args:
        task: ``prl.tasks.NAME(...)``, or the name alone.
        curriculum: ``prl.curricula.NAME(...)``, or the name alone; the default is
            ``prl.DEFAULT_METHOD``.
        scale: of the computation, for tasks that have scales: ``"smoke"``, ``"quick"``,
            ``"medium"`` or ``"paper"``; None for the task's own numbers.
        filter: of the proposed levels: ``"learnability"`` or another name in ``conf/filter``, or
            settings of a filter and its model; None for the curriculum's default.
        updates: of the Solver; None for the number of the task or scale.
        seed: of every random draw.
        folder: for the run's files; None for a new one below ``outputs/``.
        settings: other keys of ``conf/train.yaml``, for example
            ``{"solver": {"ppo": {"learning_rate": 1e-3}}}``.
        progress: whether to draw a progress bar.

    Returns:
        The run, with its measurements as tables.

    Raises:
        ValueError: in one line that names the setting, its value and what is allowed, before
            anything is written.
        DivergedError: if a number is not finite; the last checkpoint remains.
        Interrupted: if a signal asked the run to stop, after it has saved a checkpoint.
    """
    state = random.getstate()
    from proposer_rl.cli.compose import compose_and_run

    random.setstate(state)  # since rich draws from it when it is imported
    arguments(
        train, {"scale": scale, "filter": filter, "folder": folder, "settings": settings}, ["task"]
    )
    task = as_recipe("task", "task", task)
    curriculum = as_recipe("curriculum", "method", curriculum)
    words, filtered = filter_asked(filter)
    words = [*task.words, *curriculum.words, *([f"scale={scale}"] if scale else []), *words]
    words.append(f"seed={seed}")
    more: dict[str, Any] = {"compute": {"progress": progress}}
    if updates is not None:
        more["schedule"] = {"updates": updates}
    asked = [task.settings, curriculum.settings, filtered, more, settings or {}]
    return Run(compose_and_run(words, asked, None if folder is None else Path(folder)))

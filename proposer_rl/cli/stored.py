"""A run's folder as the instruments read it: its settings, its task, its checkpoints."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tensordict import TensorDict

from proposer_rl.cli.build import make_task
from proposer_rl.cli.config import ConfigError, RunConfig, saved_config
from proposer_rl.learning import PPO
from proposer_rl.runs.checkpoint import (
    CheckpointError,
    State,
    checkpoint_files,
    load_checkpoint,
    load_latest,
)
from proposer_rl.runs.folder import write_atomically
from proposer_rl.streams import Streams
from proposer_rl.task import Task


class Stage(NamedTuple):
    """The first Solver of a run after some updates.

    Attributes:
        step: the checkpoint's.
        updates: that the Solver has made.
        solver: its snapshot, batch [1].
    """

    step: int
    updates: int
    solver: TensorDict


class StoredRun(NamedTuple):
    """A run's folder.

    Attributes:
        folder: the run's.
        config: its settings.
        task: made from them.
        files: its checkpoints, oldest first; at least one.
    """

    folder: Path
    config: RunConfig
    task: Task
    files: list[Path]

    def stage(self, file: Path) -> Stage:
        """The first Solver in one of the files.

        Raises:
            CheckpointError: if it cannot be used.
        """
        step, updates, learner = self.learner(file)
        return Stage(step, updates, learner.snapshot()[:1])

    def learner(self, file: Path) -> tuple[int, int, PPO]:
        """The checkpoint's step, the updates made there, and the Solvers.

        Raises:
            CheckpointError: if it cannot be used.
        """
        step, state = load_checkpoint(file)
        learner = restored(self.task, self.config, state)
        return step, int(state["updates"]), learner


def stored_run(folder: Path) -> StoredRun:
    """A run that has checkpoints.

    Raises:
        ConfigError: if the folder holds none.
    """
    files = [file for _, file in checkpoint_files(folder / "checkpoints")]
    if not files:
        raise ConfigError(f"{folder}: holds no checkpoints; give the folders of runs")
    config = saved_config(folder)
    return StoredRun(folder, config, make_task(config), files)


def read_checkpoint(path: Path) -> tuple[Path, State]:
    """A run's folder and the state in one of its checkpoints.

    Args:
        path: the folder, for its newest checkpoint, or a checkpoint in it.

    Raises:
        ConfigError: if there is none.
        CheckpointError: if it cannot be used.
    """
    if not path.exists():
        raise ConfigError(f"{path}: there is no such file or folder")
    if not path.is_dir():
        return path.resolve().parent.parent, load_checkpoint(path)[1]
    latest = load_latest(path / "checkpoints")
    if latest is None:
        raise ConfigError(f"{path}: holds no checkpoints; give a run's folder or a checkpoint")
    return path.resolve(), latest[1]


def restored(task: Task, config: RunConfig, state: State) -> PPO:
    """PPO of the Solvers in a checkpoint.

    Raises:
        CheckpointError: if they have another network than the settings say.
    """
    learner = task.learner([Streams(seed) for seed in config.seeds])
    try:
        learner.restore(TensorDict(state["solver"], [len(config.seeds)]))
        int(state["updates"])
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise CheckpointError(
            "the checkpoint holds no Solver with the network of its run's config.json"
        ) from error
    return learner


def write_rows(rows: Sequence[Any], file: Path | None) -> None:
    """Write rows as JSON, if a file is given."""
    if file is not None:
        write_atomically(file, (json.dumps(rows, indent=1) + "\n").encode())

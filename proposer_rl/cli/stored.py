"""Reads a run's folder for evaluation and play: its settings, its task, its checkpoints."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tensordict import TensorDict

from proposer_rl.cli.build import make_task
from proposer_rl.cli.config import RunConfig, saved_config
from proposer_rl.cli.errors import ConfigError
from proposer_rl.learning import PPO
from proposer_rl.runs.checkpoint import checkpoint_files, load_checkpoint, load_latest
from proposer_rl.runs.folder import write_atomically
from proposer_rl.settings import within
from proposer_rl.streams import Streams
from proposer_rl.task import Task


class Stage(NamedTuple):
    """A run's Solvers at a checkpoint."""

    step: int
    updates: int
    learner: PPO

    @property
    def solver(self) -> TensorDict:
        """A snapshot of the first of them, batch [1]."""
        return self.learner.snapshot()[:1]


class StoredRun(NamedTuple):
    """A run that has checkpoints."""

    folder: Path
    config: RunConfig
    task: Task
    files: list[Path]  # its checkpoints, oldest first; at least one

    def stage(self, file: Path | None = None, seeds: Sequence[int] | None = None) -> Stage:
        """Returns the Solvers of some seeds in one of the files.

        Args:
            file: None for the newest checkpoint that is intact.
            seeds: None for all.
        """
        seeds = self.config.seeds if seeds is None else seeds
        if strangers := set(seeds) - set(self.config.seeds):
            raise ConfigError(f"seed={min(strangers)}: must be among {list(self.config.seeds)}")
        found = load_latest(self.files[-1].parent) if file is None else load_checkpoint(file)
        assert found is not None, "there is a checkpoint"
        step, state = found
        learner = self.task.learner([Streams(seed) for seed in seeds])
        every = TensorDict(state["solver"], [len(self.config.seeds)])
        with within("checkpoint", ValueError):  # of another network
            learner.restore(every[[self.config.seeds.index(seed) for seed in seeds]])
        return Stage(step, int(state["updates"]), learner)


def stored_run(path: Path) -> StoredRun:
    """Reads the settings of a run and makes its task.

    Args:
        path: the folder, or one of its checkpoints, which is then the only file.
    """
    folder, files = path.resolve(), [file for _, file in checkpoint_files(path / "checkpoints")]
    if path.is_file():
        folder, files = folder.parent.parent, [path]
    if not files:
        raise ConfigError(f"{path}: holds no checkpoints; give a run's folder or a checkpoint")
    config = saved_config(folder)
    return StoredRun(folder, config, make_task(config), files)


def write_rows(rows: Sequence[Any], file: Path | None) -> None:
    """Writes rows as JSON, if a file is given."""
    if file is not None:
        write_atomically(file, (json.dumps(rows, indent=1) + "\n").encode())

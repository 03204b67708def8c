"""Answers the page's questions on one run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Annotated, Any, Literal

import torch
from pydantic import BaseModel, Field

from proposer_rl.learning import PPO
from proposer_rl.runs.checkpoint import checkpoint_files
from proposer_rl.runs.folder import read_jsonl
from proposer_rl.runs.records import SampleRecord, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Board, Levels, PlayableTask, Task

SHOWN = 12  # levels of a draw
KEPT = 4  # checkpoints in memory
LARGEST_SIDE = 64  # cells of a drawing
MOST_STEPS = 5000  # of an episode

Load = Callable[[Path], tuple[int, PPO]]
"""The updates made at a checkpoint, and PPO of the Solvers in it."""


class Examine(BaseModel):
    """A request for what a Solver does on a drawing.

    Attributes:
        checkpoint: the number of one of the run's checkpoints.
        solver: the Solver's number among those that were trained side by side.
        rows: the drawing.
        max_steps: step limit; None for the task's choice.
    """

    checkpoint: int
    solver: int
    rows: list[str]
    max_steps: int | None = None


class Drawn(BaseModel):
    """A request for levels drawn from a distribution, with a Solver's results there."""

    source: Literal["distribution"]
    name: str
    seed: int
    checkpoint: int
    solver: int


class OfSet(BaseModel):
    """A request for the levels of a shipped set."""

    source: Literal["set"]
    name: str


class OfCurriculum(BaseModel):
    """A request for levels that were trained on, a row of the run's ``curriculum.jsonl``."""

    source: Literal["curriculum"]
    row: int


class OfFile(BaseModel):
    """A request for the levels in the text of a file."""

    source: Literal["file"]
    text: str


class Write(BaseModel):
    """A request for the text of a file with a drawing."""

    name: str
    rows: list[str]


Source = Annotated[Drawn | OfSet | OfCurriculum | OfFile, Field(discriminator="source")]


class Session:
    """A run and its checkpoints as the page shows them; nothing in its folder is changed.

    One thread at a time computes; the others wait.
    """

    def __init__(
        self, *, folder: Path, title: str, task: Task, seeds: Sequence[int], load: Load
    ) -> None:
        self._folder, self._title, self._task, self._seeds = folder, title, task, seeds
        # Keyed by the file's time, too, since a resumed run may rewrite a checkpoint.
        self._load = lru_cache(KEPT)(lambda file, _written: load(file))
        self._lock = Lock()
        self._board = task.board if isinstance(task, PlayableTask) else None
        facts = task.facts
        self._facts = {key: facts[key] for key in ("title", "levels", "key")}

    def about(self) -> dict[str, Any]:
        """Returns the run's checkpoints, seeds, levels and board as they are now, for JSON."""
        board = self._board
        return {
            "title": self._title,
            **{f"task_{key}": value for key, value in self._facts.items()},
            "checkpoints": list(self._checkpoints()),
            "seeds": list(self._seeds),
            "distributions": list(self._task.distributions),
            "curriculum": [
                {"updates": sample.updates, "seed": sample.seed} for sample in self._samples()
            ],
            "board": board
            and {
                "kinds": [kind._asdict() for kind in board.kinds],
                "size": board.size,
                "actions": board.actions,
                "sets": board.sets,
                "largest": LARGEST_SIDE,
                "most_steps": MOST_STEPS,
            },
        }

    def examine(self, question: Examine) -> dict[str, Any]:
        """Returns what a Solver does on a drawing; see :meth:`~proposer_rl.task.Board.examine`.

        Raises:
            ValueError: if there is no such Solver, or the drawing is no level.
            StorageError: if a checkpoint cannot be read.
        """
        board = self._require_board()
        level = board.read(question.rows)
        with self._lock, torch.no_grad():
            updates, learner = self._learner(question)
            result = board.examine(learner.agent, question.solver, level, question.max_steps)
        return {"updates": updates, **result}

    def levels(self, question: Drawn | OfSet | OfCurriculum | OfFile) -> dict[str, Any]:
        """Returns levels to choose from: pictures, and drawings where the task has a board.

        Raises:
            ValueError: if there are no such levels.
            StorageError: if the run's files cannot be read.
        """
        with self._lock:
            if isinstance(question, Drawn):
                return self._drawn(question)
            if isinstance(question, OfCurriculum):
                return self._trained_on(question.row)
            if isinstance(question, OfFile):
                return self._named(self._require_board().read_file(question.text))
            return self._named(self._require_board().level_set(question.name))

    def write(self, question: Write) -> dict[str, Any]:
        """Returns the text of a file with a drawing.

        Raises:
            ValueError: if a file cannot hold it.
        """
        board = self._require_board()
        return {"text": board.write_file(question.name, board.read(question.rows))}

    def _require_board(self) -> Board:
        if self._board is None:
            raise ValueError(f"{self._facts['levels']} cannot be drawn")
        return self._board

    def _checkpoints(self) -> dict[int, Path]:
        return dict(checkpoint_files(self._folder / "checkpoints"))

    def _samples(self) -> list[SampleRecord]:
        file = self._folder / "curriculum.jsonl"
        recorded = read_jsonl(file) if file.is_file() else []
        return checked(list[SampleRecord], recorded, file.name)

    def _learner(self, question: Examine | Drawn) -> tuple[int, PPO]:
        files = self._checkpoints()
        if question.checkpoint not in files:
            raise ValueError(f"no checkpoint {question.checkpoint}; available: {list(files)}")
        file = files[question.checkpoint]
        return self._load(file, file.stat().st_mtime_ns)

    def _drawn(self, question: Drawn) -> dict[str, Any]:
        """Returns levels drawn from a distribution, with results and an episode on each."""
        updates, learner = self._learner(question)
        copies, batch = learner.env.batch_size
        streams = Streams(question.seed, "play", question.name)
        distribution = self._task.evaluation_distribution(question.name)
        levels = distribution.sample(batch, streams.generator("levels"))
        env, collector = self._task.spectators(learner)
        env.set_levels(levels.expand(copies, batch))
        actions = [streams.generator("actions", k) for k in range(copies)]
        some, solver = slice(SHOWN), question.solver
        with torch.no_grad():
            rollout = collector.collect(actions)[solver, some]
            generator = streams.generator("performance")
            reached = self._task.performance(learner.agent, levels[some], generator)[solver].cpu()
        records = self._task.record(levels[some], rollout)
        return {
            "updates": updates,
            "levels": [
                self._shown(
                    f"{question.name}_{question.seed}_{number}",
                    record,
                    self._drawing(level),
                    {str(key): float(value) for key, value in reached[number].items()},
                )
                for number, (record, level) in enumerate(zip(records, levels[some], strict=True))
            ],
        }

    def _trained_on(self, row: int) -> dict[str, Any]:
        sample = self._samples()[row]
        shown = []
        for number, level in enumerate(sample.levels):
            record, rows = level.model_dump(), None
            if self._board is not None:
                rows = self._drawing(self._board.read(self._board.drawing(record)))
            shown.append(self._shown(f"update_{sample.updates}_{number}", record, rows))
        return {"updates": sample.updates, "levels": shown}

    def _named(self, levels: Mapping[str, Levels]) -> dict[str, Any]:
        drawings = {name: self._drawing(level) for name, level in levels.items()}
        return {
            "levels": [
                self._shown(name, self._task.record(level.unsqueeze(0), None)[0], drawings[name])
                for name, level in levels.items()
            ]
        }

    def _drawing(self, level: Levels) -> list[str] | None:
        return None if self._board is None else self._board.draw(level)

    def _shown(
        self,
        name: str,
        record: Mapping[str, Any],
        rows: list[str] | None,
        results: Mapping[str, float] | None = None,
    ) -> dict[str, Any]:
        return {
            "name": name,
            "picture": record["picture"],
            "text": record.get("text", []) if rows is None else [],
            "rows": rows,
            "results": dict(results or {}),
        }

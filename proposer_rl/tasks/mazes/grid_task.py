"""The base of tasks on mazes: drawing, editing, reading and measuring levels."""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.learning import SolverSettings, first_episode_success
from proposer_rl.models import ActorCritic, MapEncoder
from proposer_rl.settings import within
from proposer_rl.task import Board, ComputeContext, LevelResult, Task, check_distributions
from proposer_rl.tasks.mazes.drawings import (
    SETS,
    SUFFIXES,
    level_records,
    levels_from_text,
    levels_to_text,
    read_levels,
    recorded_drawing,
)
from proposer_rl.tasks.mazes.generation import edit_levels
from proposer_rl.tasks.mazes.levels import Level, shortest_path_length

STEPS_PER_SHORTEST = 2  # allowed on a named level for each step of its shortest way
_ON_A_GRID = re.compile(r"(.+?)(?:@(\d{1,3})x(\d{1,3}))?")


class GridTask(Task):
    """A task on mazes, whatever an agent can do and see there.

    Args:
        maze: the inner environment's settings: ``height``, ``width``, ``max_steps`` and others.
        distributions: settings by name.
        target: the name of the distribution that the Solver is to master.
        space: settings of the Proposer's bins.
        encoder_channels: of the convolutions by which a Proposer reads a probe.
        evaluation: settings: ``distributions``, ``levels``, ``seed`` and ``episodes``.
        solver: the Solver's training.
        context: device, precision and cores.

    Attributes:
        level: class of the levels.
        fewest_steps: function of levels [*B] to the steps of a shortest way to the goal, int64
            [*B], -1 for none.
        probe_planes: count of a probe's planes.
        steps_name: name of the shortest way's steps in results.
        counting: a remark for readers on how steps are counted.
        board: for drawing and playing levels in ``bin/play``.

    Raises:
        ValueError: naming the key, if settings contradict each other.
    """

    noun = "mazes"
    key = "Blue: start. Orange: goal. Purple: the Solver's first episode there."
    level: ClassVar[type[Level]] = Level
    fewest_steps: Callable[[Any], Tensor]
    probe_planes: ClassVar[int]
    steps_name: ClassVar[str]
    counting: ClassVar[str] = ""
    edit = staticmethod(edit_levels)
    board: Board

    def __init__(
        self,
        maze: Any,
        distributions: Mapping[str, Any],
        target: str,
        space: Any,
        encoder_channels: Sequence[int],
        evaluation: Any,
        solver: SolverSettings,
        context: ComputeContext,
    ) -> None:
        check_distributions(distributions, target, evaluation.distributions)
        self.maze = maze
        self.grid = (maze.height, maze.width)
        self.device = torch.device(context.device)  # the distributions need it
        self._kinds, self._target = dict(distributions), target
        self._encoder_channels = encoder_channels
        with within("space", ValueError):
            bins = self.make_space(space)
        rules = asdict(maze)
        rules.pop("observe_agent", None)
        super().__init__(
            distributions={
                name: self._made(f"distributions.{name}", kind, *self.grid)
                for name, kind in distributions.items()
            },
            target=target,
            space=bins,
            solver=solver,
            context=context,
            measured_on=evaluation.distributions,
            levels=evaluation.levels,
            seed=evaluation.seed,
            max_steps=maze.max_steps,
            episodes=evaluation.episodes,
            measured={
                "maze": rules,
                "distributions": {
                    name: asdict(distributions[name])
                    for name in (*evaluation.distributions, target)
                },
                "target": target,
                "levels": [evaluation.levels, evaluation.seed]
                + ([] if self.exact_metrics else [evaluation.episodes]),
            },
        )
        self.default_levels = "shapes"

    def probe_encoder(self, features: int) -> MapEncoder:
        """Returns a convolutional network for probes."""
        return MapEncoder(self.probe_planes, self._encoder_channels, features)

    def training_metrics(self, levels: Level, rollout: TensorDictBase) -> TensorDict:
        """Returns statistics of training levels [K, P] and episodes on them, each [K].

        - ``obstacle_fraction``: obstacles per cell;
        - ``path_length``, ``path_length_sd``: mean and standard deviation of the moves on the
          shortest path, over the levels that have a path; both 0 if none has one;
        - ``solvable``: share of levels whose goal can be reached within the step limit;
        - ``train_success``: share of levels whose goal was reached in the first episode.
        """
        length, steps = shortest_path_length(levels), self.fewest_steps(levels)
        mean, deviation = _moments(length.float(), length >= 0)
        solvable = (steps >= 0) & (steps <= self.maze.max_steps)
        metrics = {
            "obstacle_fraction": levels.walls.float().mean((-3, -2, -1)),
            "path_length": mean,
            "path_length_sd": deviation,
            "solvable": solvable.float().mean(-1),
            "train_success": first_episode_success(rollout).float().mean(-1),
        }
        return TensorDict(metrics, levels.batch_size[:1])

    def record(self, levels: Level, rollout: TensorDictBase | None) -> list[dict[str, Any]]:
        """Returns drawings of levels [n], with the Solver's first episode there [n, T]."""
        return list(level_records(levels, rollout))

    @property
    def about(self) -> dict[str, str]:
        """Returns facts about the task for readers, by their labels."""
        height, width = self.grid
        kinds = "; ".join(
            f"{name.upper()} ({self.distributions[name]})" for name in self.evaluated_on
        )
        return {
            "Mazes": f"{height}×{width}, at most {self.maze.max_steps} steps{self.counting}",
            "Measured on": f"{kinds}; {self._levels} fixed levels each"
            + ("" if self.exact_metrics else f", episodes on each: {self.episodes}"),
        }

    @abstractmethod
    def make_distribution(self, settings: Any, height: int, width: int) -> Any:
        """Returns the distribution of these settings on a grid."""

    @abstractmethod
    def make_space(self, settings: Any) -> Any:
        """Returns the Proposer's bins."""

    @abstractmethod
    def results_on(
        self, agent: ActorCritic, levels: Any, names: Sequence[str], max_steps: int
    ) -> Mapping[str, Tensor]:
        """Returns the results of K Solvers on levels [n] of one size, by name, each [K, n]."""

    @abstractmethod
    def at_once(self, cells: int) -> int:
        """Returns how many levels to evaluate together, for levels of so many cells."""

    def check_level(self, name: str, level: Level) -> None:
        """Checks that Solvers can see a level.

        Raises:
            ValueError: naming the level, if they cannot.
        """

    def _made(self, key: str, settings: Any, height: int, width: int) -> Any:
        with within(key, ValueError):
            return self.make_distribution(settings, height, width)

    def step_limit(self, steps: int, slack: int = STEPS_PER_SHORTEST) -> int:
        """Returns the step limit of a level with so many steps on its shortest way."""
        return max(self.maze.max_steps, slack * steps)

    def level_results(
        self, agent: ActorCritic, name: str, max_steps: int | None
    ) -> list[LevelResult]:
        """Returns the results of Solvers on levels of a distribution, a file or an included set.

        Without a step limit, levels of a distribution have the task's, also on another grid
        (``id@13x13``), so that means equal the run's metrics. Other levels have at least twice the
        steps of a shortest way.
        """
        levels, slack = self._named_levels(name)
        for known, level in levels.items():
            self.check_level(known, level)
        return self.results_of(
            agent, levels, lambda steps: max_steps or self.step_limit(steps, slack)
        )

    def results_of(
        self, agent: ActorCritic, levels: Mapping[str, Any], limit_of: Callable[[int], int]
    ) -> list[LevelResult]:
        """Returns the results of K Solvers on levels of any size, in the levels' order.

        Levels of one size and step limit are evaluated together.

        Args:
            agent: K Solvers.
            levels: of batch shape [], by name.
            limit_of: function of the steps of a level's shortest way to its step limit.
        """
        about: dict[str, dict[str, int]] = {}
        batches: dict[tuple[int, ...], list[str]] = {}
        for known, level in levels.items():
            steps, (height, width) = int(self.fewest_steps(level)), level.walls.shape
            limit = limit_of(steps)
            size = {"height": height, "width": width}
            about[known] = {**size, self.steps_name: steps, "max_steps": limit}
            batches.setdefault((limit, height, width), []).append(known)
        results: list[LevelResult] = []
        for (limit, height, width), members in batches.items():
            together = max(self.at_once(height * width), 1)
            for first in range(0, len(members), together):
                names = members[first : first + together]
                batch: Any = torch.stack([levels[name] for name in names])
                found = self.results_on(agent, batch.to(self.device), names, limit)
                for i, name in enumerate(names):
                    for k in range(agent.copies or 1):
                        numbers = {key: float(values[k, i]) for key, values in found.items()}
                        results.append(LevelResult(name, k, about[name], numbers))
        place = {known: number for number, known in enumerate(levels)}
        return sorted(results, key=lambda result: (place[result.level], result.solver))

    def _named_levels(self, name: str) -> tuple[dict[str, Any], int]:
        """Returns levels for ``--levels``, and the steps allowed for each of a shortest way.

        Raises:
            ValueError: if there are no levels of this name.
            StorageError: if a file cannot be read.
        """
        if name in SETS or Path(name).suffix in SUFFIXES:
            return read_levels(SETS.get(name, name), self.level), STEPS_PER_SHORTEST
        asked = _ON_A_GRID.fullmatch(name)
        for known, kind in self._kinds.items():
            if asked is None or known.casefold() != asked[1].casefold():
                continue
            levels: Any
            if asked[2] is None:
                levels = self.evaluation_levels(known)
            else:  # the same levels and names for any case of the letters
                size = [int(cells) for cells in asked.group(2, 3)]
                known = f"{known}@{size[0]}x{size[1]}"
                grid = self._made(f"--levels {known}", kind, *size)
                levels = grid.sample(self._levels, self.stream("levels", known))
            return {f"{known}_{i:03}": levels[i].cpu() for i in range(len(levels))}, 0
        raise ValueError(
            f"--levels {name}: must be one of: {', '.join(SETS)}, a file that ends in "
            f"{' or '.join(SUFFIXES)}, or a distribution: {', '.join(self._kinds)}, as it is "
            f"or on another grid, as in {self._target}@13x13"
        )


class Drawings:
    """Reads and draws mazes; the base of a :class:`~proposer_rl.task.Board`.

    Args:
        task: the task of the levels.
    """

    sets = tuple(SETS)

    def __init__(self, task: GridTask) -> None:
        self._task = task
        self.size = task.grid

    def read(self, rows: Sequence[str]) -> Any:
        """Returns the level of a drawing; see :class:`~proposer_rl.task.Board`."""
        level = self._task.level.from_text("\n".join(rows))
        self._task.check_level("drawn", level)
        return level

    def draw(self, level: Level) -> list[str]:
        """Returns the rows of a level's drawing."""
        return str(level.to_text()).splitlines()

    def drawing(self, record: Mapping[str, Any]) -> list[str]:
        """Returns the rows of a record's level, without the Solver's path."""
        return recorded_drawing(record["text"])

    def level_set(self, name: str) -> Mapping[str, Level]:
        """Returns the levels of an included set; agents with a direction look to the right."""
        return read_levels(SETS[name], self._task.level)

    def read_file(self, text: str) -> Mapping[str, Level]:
        """Returns the levels of a file's text; see docs/how_to/levels.md for the format."""
        return levels_from_text(text, kind=self._task.level)

    def write_file(self, name: str, level: Level) -> str:
        """Returns a file's text with a level; see docs/how_to/levels.md for the format."""
        return levels_to_text({name: level})


def _moments(values: Tensor, which: Tensor) -> tuple[Tensor, Tensor]:
    """Returns mean and deviation of chosen values among [*B, P], 0 for none: float [*B] each."""
    count = which.sum(-1).clamp_min(1)
    mean = (values * which).sum(-1) / count
    square = (values - mean.unsqueeze(-1)).square()
    return mean, ((square * which).sum(-1) / count).sqrt()

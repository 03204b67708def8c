"""The contract of a task: what loops, curricula, commands and reports may ask of an environment.

A task is any object with these members; nothing is inherited. What it takes as a level is its own
business: a tensordict or tensorclass of any content, whose batch shape alone is looked at. K are
Solvers, P the levels of one update, T its steps, E validation levels, C probes, N bins.

:class:`~proposer_rl.tasks.mazes.task.MazeTask` is one, ``examples/mountain_car.py`` another.
Methods that
need more of a task than all of them have ask for it by name, with the optional parts below.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor, nn

from proposer_rl.learning import PPO
from proposer_rl.models import ActorCritic
from proposer_rl.streams import Streams

Levels = Any
"""A tensordict or tensorclass of levels."""


class NoSuccessError(ValueError):
    """A task tells no success, and it was asked for; the message is a line that says what to do."""

    exit_code = 2


class Place(NamedTuple):
    """Where and how exactly a task computes; what makes a task is called with one.

    Attributes:
        device: where Solvers and levels live.
        precision: of the Solvers' networks: ``"fp32"``, ``"bf16"``, or ``"auto"`` for the task's
            choice.
        cores: Solvers of a population computed at once on a CPU; None for all cores.
    """

    device: torch.device = torch.device("cpu")
    precision: str = "fp32"
    cores: int | None = None


class Distribution(Protocol):
    """Levels to draw from."""

    def sample(self, count: int, generator: torch.Generator, /) -> Levels:
        """Draw levels [count] on the task's device; the generator is one of the CPU."""


class Space(Distribution, Protocol):
    """The levels that a Proposer chooses among, in N bins; ``sample`` draws evenly from them.

    Attributes:
        axes: the values along each axis, by the axis's name; the bins are their product, the last
            axis running fastest.
        size: the number N of bins.
        coordinates: of each bin, scaled to [-1, 1] along every axis, float32 [N, D] on the CPU.
    """

    axes: Mapping[str, Sequence[float]]
    size: int
    coordinates: Tensor

    def generate(self, choices: Tensor, generators: Sequence[torch.Generator], /) -> Levels:
        """Levels [K, P] of bins, int64 [K, P], on the task's device; copy k's from generator k."""


@runtime_checkable
class Task(Protocol):
    """An environment in which Solvers are trained, and how they are looked at.

    Attributes:
        device: where Solvers and levels live.
        precision: of the Solvers' networks, ``"fp32"`` or ``"bf16"``.
        batch_size: levels P of an update of one Solver.
        target: the distribution that is to be mastered.
        space: what a Proposer chooses among.
        distributions: by name, for curricula by hand.
        measurements: the names of what :meth:`measure` tells.
        exact_performance: whether :meth:`performance` draws nothing at random.
    """

    device: torch.device
    precision: str
    batch_size: int
    target: Distribution
    space: Space
    distributions: Mapping[str, Distribution]
    measurements: Sequence[str]
    exact_performance: bool

    @property
    def facts(self) -> dict[str, Any]:
        """What a reader of a run is told of the task, for JSON.

        - ``title``: of its runs, and ``levels``: what levels are called;
        - ``distributions``: names of those measured on; ``<name>_success`` are their columns;
        - ``space``: the axes of the Proposer's bins;
        - ``about``: texts by their labels; ``key`` and ``text_key``: what is to be seen in a
          record's picture and in its text;
        - ``measured``: all that must be equal for two runs' measurements to be comparable;
        - ``exact``: whether the measurements draw nothing at random;
        - ``samples``: records (see :meth:`record`) of levels of each distribution measured on.
        """

    def learner(self, streams: Sequence[Streams]) -> PPO:
        """PPO of K fresh Solvers, one for each of the streams, in their environment [K, P].

        The environment has a method ``set_levels(levels [K, P])``; it plays them from its next
        reset on.
        """

    def performance(
        self, agent: ActorCritic, levels: Levels, generator: torch.Generator
    ) -> TensorDictBase:
        """What K Solvers reach on levels [E], or each on its own [K, E]: a tensordict [K, E].

        ``return`` float [K, E] is the expected return of an episode or an estimate of it,
        ``success`` the probability of success, where that has a meaning. An exact evaluation has no
        use for the generator, which is on the CPU.
        """

    def probe(self, agent: ActorCritic, levels: Levels) -> Tensor:
        """What K Solvers would do on levels [C], as a Proposer sees it: float [K, C, ...]."""

    def probe_encoder(self, features: int) -> nn.Module:
        """A network from probes [*B, ...] to features [*B, features]."""

    def measure(self, agent: ActorCritic) -> TensorDictBase:
        """Measurements of K Solvers by name, each float [K]: the columns of ``metrics.csv``."""

    def performances(self, agent: ActorCritic) -> Mapping[str, TensorDictBase]:
        """What K Solvers reach on each of the levels behind the measurements.

        By the names of the distributions measured on, a :meth:`performance` each, [K, E].
        """

    def statistics(self, levels: Levels, rollout: TensorDictBase) -> TensorDictBase:
        """What Solvers trained on, levels [K, P] and rollout [K, P, T], by name, each [K]."""

    def record(self, levels: Levels, rollout: TensorDictBase | None) -> list[dict[str, Any]]:
        """Levels [n], and what one Solver did there [n, T], for JSON and to be looked at.

        Each record has a ``picture``, a PNG in base64, and may have ``text``, its lines as they
        are shown in a terminal, and anything else.
        """


@runtime_checkable
class DifferentiableTask(Protocol):
    """A task whose performance has gradients: first-order gain without sampling."""

    def differentiable_performance(self, agent: ActorCritic, levels: Levels) -> TensorDictBase:
        """Return and success of K Solvers, each on its own levels [K, E]: a tensordict [K, E].

        Where gradients are enabled, with gradients towards the agent's parameters.
        """


class ExactTask(Task, DifferentiableTask, Protocol):
    """A whole task whose performance has gradients."""


@runtime_checkable
class LocatedTarget(Protocol):
    """A task whose target lies in the Proposer's space: a way from other bins to it.

    Attributes:
        target_shares: the target as shares of the bins, float [N] on the CPU; they add up to one.
    """

    target_shares: Tensor


@runtime_checkable
class OptimalTask(Protocol):
    """A task that knows what could be reached: regret without an antagonist."""

    def optimal_return(self, levels: Levels) -> Tensor:
        """The largest expected return that any policy reaches on levels [*B]: float [*B]."""


class EpisodeLaw(NamedTuple):
    """The law of a Solver's episodes on levels [*B], in two tables.

    Attributes:
        outcome: returns that an episode can have, float64 [*B, O].
        probability: of each, float64 [*B, O].
        weight: of every step that can be taken, a state with an action: the expectation of its
            share of an episode's steps, float64 [*B, M]. So the sum of weight times any number is
            the expectation of that number's mean over the steps of an episode.
        reward: of the step, float64 [*B, M].
        value: that the critic gives the state before it, float64 [*B, M].
        next_value: the same of the state after it, 0 where the step terminates the episode.
    """

    outcome: Tensor
    probability: Tensor
    weight: Tensor
    reward: Tensor
    value: Tensor
    next_value: Tensor


@runtime_checkable
class EnumerableTask(Protocol):
    """A task all of whose episodes can be told: scores of spread and of the critic, exactly."""

    def episode_law(self, agent: ActorCritic, levels: Levels) -> EpisodeLaw:
        """The law of the episodes of K Solvers, each on its own levels [K, E]."""


@runtime_checkable
class EditableTask(Protocol):
    """A task whose levels can be changed a little."""

    def edit(self, levels: Levels, count: int, generators: Sequence[torch.Generator], /) -> Levels:
        """Levels [K, n] after ``count`` small random edits each; copy k's from generator k."""


class Score(NamedTuple):
    """What one Solver does on one named level.

    Attributes:
        level: its name.
        solver: the Solver's number among those of a population.
        about: what the level is like, by name.
        results: ``success`` and ``return``, and whatever else the task tells, by name.
        note: a few words for below a picture.
        picture: draws what the Solver does there, uint8 [H, W, 3].
    """

    level: str
    solver: int
    about: Mapping[str, float]
    results: Mapping[str, float]
    note: str
    picture: Callable[[], NDArray[np.uint8]]


@runtime_checkable
class ScoringTask(Protocol):
    """A task with named levels: files of them, sets that come along.

    Attributes:
        default_levels: name of the set that is taken where none is named.
    """

    default_levels: str

    def scores(self, agent: ActorCritic, name: str, max_steps: int | None) -> Sequence[Score]:
        """How K Solvers do on each level of a set, in the set's order.

        Args:
            agent: K Solvers.
            name: of the set: a file, a distribution or whatever else there is.
            max_steps: step limit of every level; None for the task's choice.

        Raises:
            ValueError: if there is no such set, or its levels are none for these Solvers.
            StorageError: if a file cannot be read.
        """


class CellKind(NamedTuple):
    """What a cell of a drawing can be.

    Attributes:
        mark: its character.
        name: what it is called, one word.
        once: whether a drawing has exactly one of it, or of all kinds of its name.
    """

    mark: str
    name: str
    once: bool = False


class Board(Protocol):
    """Levels as drawings with one character per cell, and all that a Solver does on one.

    Attributes:
        kinds: of cells, the empty one first.
        size: rows and columns of the run's own levels.
        actions: the arrow key of each action, up, down, left or right, in any order.
        sets: names of the sets of levels that come along.
    """

    kinds: Sequence[CellKind]
    size: tuple[int, int]
    actions: Sequence[str]
    sets: Sequence[str]

    def read(self, rows: Sequence[str]) -> Levels:
        """The level [] that is drawn.

        Raises:
            ValueError: if it is none, or none for the Solvers of this task.
        """

    def draw(self, level: Levels) -> list[str]:
        """The drawing of a level [], one text for each row; the inverse of :meth:`read`."""

    def drawing(self, record: Mapping[str, Any]) -> list[str]:
        """The drawing of the level in one of the task's records (:meth:`Task.record`)."""

    def level_set(self, name: str) -> Mapping[str, Levels]:
        """The levels [] of one of the sets, by their names."""

    def read_file(self, text: str) -> Mapping[str, Levels]:
        """The levels [] in the text of a file, by their names.

        Raises:
            ValueError: if it is no such text.
        """

    def write_file(self, name: str, level: Levels) -> str:
        """The text of a file with one level [].

        Raises:
            ValueError: if the name or the level cannot stand in a file.
        """

    def examine(
        self, agent: ActorCritic, solver: int, level: Levels, max_steps: int | None
    ) -> dict[str, Any]:
        """What one of K Solvers does on a level [] with H x W cells, for JSON.

        A way is a list of places: row and column, and where an agent turns its direction, too: 0
        right, 1 down, 2 left, 3 up.

        - ``results``: numbers by name, ``success`` and ``return`` of the sampled policy among them;
        - ``episodes``: by how many they were found; absent where they are exact;
        - ``policy``: for every cell the probability of each action; None where there is none to
          take: [H][W][A]; absent where a Solver does not act by the cell alone;
        - ``maps``: further numbers of every cell by what they are, [H][W], None where there is
          none;
        - ``paths``: ``solver``, the way of the most probable actions, ``shortest``, or None where
          there is no path, and without a policy ``sampled``, ways of sampled episodes;
        - ``next``: where each action leads from each place, [A][H * W], cells counted row by row,
          or [A][H * W * 4], the directions of each cell one after another;
        - ``goal``: the cell (row, column) that ends an episode with success;
        - ``max_steps``, ``step_penalty`` (of an episode that reaches the goal), ``missed`` (the
          return of one that does not): the rules.

        Args:
            agent: K Solvers.
            solver: which of them.
            level: as :meth:`read` gives it.
            max_steps: step limit; None for the task's choice.

        Raises:
            ValueError: if what the Solver answers is no policy.
        """


@runtime_checkable
class PlayableTask(Protocol):
    """A task whose levels can be drawn by hand, and played in ``bin/play``."""

    board: Board

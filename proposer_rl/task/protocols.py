"""The interfaces of a task's parts, and of optional abilities that some curricula need.

K are Solvers, P the levels of one update, E validation levels, N bins. Levels are a tensordict or
tensorclass of any content; only their batch shape matters here. A task has an ability if it has the
members of its protocol.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from tensordict import TensorDictBase
from torch import Tensor

from proposer_rl.models import ActorCritic
from proposer_rl.settings import ArgumentError

MANY_BINS = 256  # with more, a model of outcomes has no coefficient for each bin
MOST_COUNTED = 100_000_000  # bins

Levels = Any
"""A tensordict or tensorclass of levels."""


class NoSuccessError(ValueError):
    """A task without success was asked for it; the message is one line that says what to do."""

    exit_code = 2


class ComputeContext(NamedTuple):
    """The device, precision and cores with which a task computes.

    Attributes:
        device: of Solvers and levels.
        precision: of the Solvers' networks: ``"fp32"``, ``"bf16"``, or ``"auto"`` for the task's
            choice.
        cores: Solvers of a population computed at once on a CPU; None for all cores.
        graphs: whether a GPU replays recorded CUDA graphs.
        compile: whether gradient steps are compiled.
    """

    device: torch.device = torch.device("cpu")
    precision: str = "fp32"
    cores: int | None = None
    graphs: bool = True
    compile: bool = False


class Distribution(Protocol):
    """A distribution of levels."""

    def sample(self, count: int, generator: torch.Generator, /) -> Levels:
        """Draws levels [count] on the task's device, by a generator on the CPU."""


class Space(Distribution, Protocol):
    """The levels among which a Proposer chooses, in N bins; ``sample`` draws uniformly."""

    @property
    def axes(self) -> Mapping[str, Sequence[float]]:
        """Returns the values along each axis, by the axis's name.

        The bins are their product, the last axis running fastest.
        """

    @property
    def size(self) -> int:
        """Returns the number N of bins."""

    @property
    def coordinates(self) -> Tensor:
        """Returns each bin's coordinates, -1 to 1 along every axis: float32 [N, D] on the CPU."""

    def generate(self, choices: Tensor, generators: Sequence[torch.Generator], /) -> Levels:
        """Draws levels [K, P] from bins, int64 [K, P], on the device; generator k draws row k."""


class LevelResult(NamedTuple):
    """One Solver's results on one level, a row of ``bin/eval``.

    Attributes:
        level: the level's name.
        solver: the Solver's number in its population.
        about: facts about the level, by name.
        results: ``success``, ``return`` and others, by name.
    """

    level: str
    solver: int
    about: Mapping[str, float]
    results: Mapping[str, float]


@runtime_checkable
class DifferentiableTask(Protocol):
    """A task whose performance has gradients, for first-order gain without sampling."""

    def differentiable_performance(self, agent: ActorCritic, levels: Levels) -> TensorDictBase:
        """Computes return and success of K Solvers on their own levels [K, E].

        If gradients are enabled, the results have gradients of the agent's parameters.
        """


@runtime_checkable
class LocatedTarget(Protocol):
    """A task whose target lies in the Proposer's space, so that there is a path to it.

    Attributes:
        target_shares: the target's share in each bin, float [N] on the CPU; they add up to one.
    """

    target_shares: Tensor


@runtime_checkable
class OptimalTask(Protocol):
    """A task that knows the best possible return, for regret without an antagonist."""

    def optimal_return(self, levels: Levels) -> Tensor:
        """Returns the largest expected return that a policy reaches on levels [*B]: float [*B]."""


@runtime_checkable
class EditableTask(Protocol):
    """A task whose levels can be edited."""

    def edit(self, levels: Levels, count: int, generators: Sequence[torch.Generator], /) -> Levels:
        """Returns levels [K, n] after ``count`` small random edits; generator k edits row k."""


class CellKind(NamedTuple):
    """A kind of cell in a drawing.

    Attributes:
        mark: its character.
        name: one word for readers.
        once: whether a drawing has exactly one cell of this name.
    """

    mark: str
    name: str
    once: bool = False


class Board(Protocol):
    """Draws levels with one character per cell, and shows what a Solver does on them."""

    @property
    def kinds(self) -> Sequence[CellKind]:
        """The kinds of cells, the empty one first."""

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of the run's own levels."""

    @property
    def actions(self) -> Sequence[str]:
        """The arrow key of each action, up, down, left or right, in any order."""

    @property
    def sets(self) -> Sequence[str]:
        """Names of the included sets of levels."""

    def read(self, rows: Sequence[str]) -> Levels:
        """Returns the level [] of a drawing.

        Raises:
            ValueError: if it is not a level, or not one that this task's Solvers can see.
        """

    def draw(self, level: Levels) -> list[str]:
        """Returns the rows of a level's drawing; the inverse of :meth:`read`."""

    def drawing(self, record: Mapping[str, Any]) -> list[str]:
        """Returns the rows of the level's drawing in one of the task's records."""

    def level_set(self, name: str) -> Mapping[str, Levels]:
        """Returns the levels [] of an included set, by name."""

    def read_file(self, text: str) -> Mapping[str, Levels]:
        """Returns the levels [] in the text of a file, by name.

        Raises:
            ValueError: if the text has another format.
        """

    def write_file(self, name: str, level: Levels) -> str:
        """Returns the text of a file with one level [].

        Raises:
            ValueError: if a file cannot hold the name or the level.
        """

    def examine(
        self, agent: ActorCritic, solver: int, level: Levels, max_steps: int | None
    ) -> dict[str, Any]:
        """Returns the behaviour of one of K Solvers on a level [] with H x W cells, for JSON.

        A path is a list of places: row and column, and the direction of an agent that turns: 0
        right, 1 down, 2 left, 3 up.

        - ``results``: numbers by name, among them ``success`` and ``return`` of the sampled policy;
        - ``episodes``: count of episodes for these; absent if they are exact;
        - ``policy``: the probability of each action in every cell, None in cells without one:
          [H][W][A]; absent if a Solver does not act by the cell alone;
        - ``maps``: further numbers of every cell by their title, [H][W], or None in a cell;
        - ``paths``: ``solver``, the path of the most probable actions; ``shortest``, None if there
          is none; and without a policy ``sampled``, paths of sampled episodes;
        - ``next``: the place after each action in each place, [A][H * W] with cells counted row by
          row, or [A][H * W * 4] with four directions of each cell;
        - ``goal``: the cell (row, column) that ends an episode with success;
        - ``max_steps``, ``step_penalty`` (in an episode that reaches the goal) and ``missed`` (the
          return of an episode that does not).

        Args:
            agent: K Solvers.
            solver: number of one of them.
            level: as of :meth:`read`.
            max_steps: step limit; None for the task's choice.

        Raises:
            ValueError: if the Solver's output is not a policy.
        """


@runtime_checkable
class PlayableTask(Protocol):
    """A task whose levels can be drawn and played in ``bin/play``."""

    board: Board


def space_features(space: Any, levels: Levels) -> Tensor:
    """Returns features of levels by their coordinates c in a space.

    They are 1, c, c squared, and for each bin whether it is the nearest, unless there are more than
    :data:`MANY_BINS`.

    Args:
        space: with ``coordinates`` float [N, D] of its N bins, and ``locate(levels)``, the
            coordinates of levels [*B]: float [*B, D].
        levels: [*B].

    Returns:
        float64 [*B, 1 + 2 D + N] on the CPU.

    Raises:
        ArgumentError: if the space has no axes.
    """
    c = space.locate(levels).double().cpu()
    if not c.shape[-1]:
        raise ArgumentError(
            "space: must have axes, by which a model of outcomes tells levels apart; levels that "
            "are only seeds have none"
        )
    parts = [torch.ones_like(c[..., :1]), c, c.square()]
    if space.size <= MANY_BINS:
        parts.append(torch.nn.functional.one_hot(nearest_bins(space, c), space.size).double())
    return torch.cat(parts, -1)


def nearest_bins(space: Space, places: Tensor) -> Tensor:
    """Returns the bins of a space that are nearest to places in it.

    Args:
        space: with axes.
        places: as its ``coordinates``, float [*B, D] on the CPU.

    Returns:
        int64 [*B].
    """
    distances = torch.cdist(places.double().flatten(0, -2), space.coordinates.double())
    return distances.argmin(-1).view(places.shape[:-1])


def level_inputs(space: Any, levels: Levels) -> Tensor:
    """Returns a belief's inputs for levels [*B] of a space: float64 [*B, D] on the CPU.

    They come from ``space.inputs(levels)`` or else ``space.locate(levels)``; without such a method
    D is 0.
    """
    for name in ("inputs", "locate"):
        if hasattr(space, name):
            known: Tensor = getattr(space, name)(levels).double().cpu()
            return known
    return torch.zeros(*levels.shape, 0, dtype=torch.float64)


def for_copies(agent: ActorCritic, levels: Levels) -> Levels:
    """Returns levels [K, E], expanded for K Solvers if they share levels [E]."""
    return levels.expand(agent.copies, levels.batch_size[-1])


def check_distributions(known: Mapping[str, Any], target: str, measured: Sequence[str]) -> None:
    """Checks that distributions with these names exist.

    Raises:
        ValueError: naming the key, if one does not.
    """
    for key, names in (("target", [target]), ("evaluation.distributions", measured)):
        unknown = [name for name in names if name not in known]
        if unknown:
            raise ValueError(f"{key}: must be among {sorted(known)}, got {unknown[0]!r}")


def refuse_unfit_bins(space: Space, least: int = 2) -> None:
    """Checks that a space has enough bins to choose among, and few enough to count each.

    Raises:
        ArgumentError: if it has fewer than ``least``, or more than ``MOST_COUNTED``.
    """
    if not least <= space.size <= MOST_COUNTED:
        raise ArgumentError(
            f"space: {space.size:,} bins: must be {least} to {MOST_COUNTED:,}; give its axes more "
            "or fewer, or set bins=1 with rounded=false where a curriculum has that"
        )

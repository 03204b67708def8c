"""The interface of a task, and optional abilities that some curricula ask for.

K are Solvers, P the levels of one update, E validation levels, N bins. What a task takes as a level
is its own business: a tensordict or tensorclass of any content, whose batch shape alone matters.
Curricula that need more than every task has ask for it by name, with the optional parts at the end;
a task has one by having its members.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from tensordict import TensorDictBase
from torch import Tensor

from proposer_rl.models import ActorCritic
from proposer_rl.settings import ArgumentError

MANY_BINS = 256  # beyond which a model of outcomes has no coefficient for each of them
MOST_COUNTED = 100_000_000  # bins

Levels = Any
"""A tensordict or tensorclass of levels."""


class NoSuccessError(ValueError):
    """A task has no success, and it was asked for; the message is a line that says what to do."""

    exit_code = 2


class ComputeContext(NamedTuple):
    """The device and precision with which a task computes, given to what makes tasks.

    Attributes:
        device: where Solvers and levels live.
        precision: of the Solvers' networks: ``"fp32"``, ``"bf16"``, or ``"auto"`` for the task's
            choice.
        cores: Solvers of a population computed at once on a CPU; None for all cores.
        graphs: whether a GPU replays what can be recorded as CUDA graphs.
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
        """Draws levels [count] on the task's device; the generator is one of the CPU."""


class Space(Distribution, Protocol):
    """The levels that a Proposer chooses among, in N bins; ``sample`` draws uniformly from them."""

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
        """Returns each bin's place, -1 to 1 along every axis: float32 [N, D] on the CPU."""

    def generate(self, choices: Tensor, generators: Sequence[torch.Generator], /) -> Levels:
        """Draws levels [K, P] of bins, int64 [K, P], on the task's device; row k by generator k."""


class LevelResult(NamedTuple):
    """One Solver's results on one level, as ``bin/eval`` lists them.

    Attributes:
        level: the level's name.
        solver: the Solver's number among those of a population.
        about: what the level is like, by name.
        results: the performance, ``success`` and ``return``, and whatever else there is, by name.
    """

    level: str
    solver: int
    about: Mapping[str, float]
    results: Mapping[str, float]


@runtime_checkable
class DifferentiableTask(Protocol):
    """A task whose performance has gradients: first-order gain without sampling."""

    def differentiable_performance(self, agent: ActorCritic, levels: Levels) -> TensorDictBase:
        """Computes return and success of K Solvers on their own levels [K, E], with gradients.

        Where gradients are enabled, with gradients towards the agent's parameters.
        """


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
        """Returns the largest expected return that a policy reaches on levels [*B]: float [*B]."""


@runtime_checkable
class EditableTask(Protocol):
    """A task whose levels can be changed a little."""

    def edit(self, levels: Levels, count: int, generators: Sequence[torch.Generator], /) -> Levels:
        """Returns levels [K, n] after ``count`` small random edits; row k by generator k."""


class CellKind(NamedTuple):
    """A kind of cell in a drawing.

    Attributes:
        mark: its character.
        name: what it is called, one word.
        once: whether a drawing has exactly one of it, or of all kinds of its name.
    """

    mark: str
    name: str
    once: bool = False


class Board(Protocol):
    """Levels as drawings with one character per cell, and all that a Solver does on one."""

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
        """Names of the shipped sets of levels."""

    def read(self, rows: Sequence[str]) -> Levels:
        """Returns the level [] that is drawn.

        Raises:
            ValueError: if it is none, or none for the Solvers of this task.
        """

    def draw(self, level: Levels) -> list[str]:
        """Returns the drawing of a level [], a text for each row; the inverse of :meth:`read`."""

    def drawing(self, record: Mapping[str, Any]) -> list[str]:
        """Returns the drawing of the level in one of the task's records."""

    def level_set(self, name: str) -> Mapping[str, Levels]:
        """Returns the levels [] of one of the sets, by their names."""

    def read_file(self, text: str) -> Mapping[str, Levels]:
        """Returns the levels [] in the text of a file, by their names.

        Raises:
            ValueError: if it is no such text.
        """

    def write_file(self, name: str, level: Levels) -> str:
        """Returns the text of a file with one level [].

        Raises:
            ValueError: if the name or the level cannot stand in a file.
        """

    def examine(
        self, agent: ActorCritic, solver: int, level: Levels, max_steps: int | None
    ) -> dict[str, Any]:
        """Returns what one of K Solvers does on a level [] with H x W cells, for JSON.

        A way is a list of places: row and column, and where an agent turns its direction, too: 0
        right, 1 down, 2 left, 3 up.

        - ``results``: numbers by name, ``success`` and ``return`` of the sampled policy among them;
        - ``episodes``: how many were played for these; absent where they are exact;
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
    """A task whose levels can be drawn, and played in ``bin/play``."""

    board: Board


def space_features(space: Any, levels: Levels) -> Tensor:
    """Returns features of levels by where they lie in a space, among the bins or beside them.

    With c the coordinates of a level: 1, c, c squared, and for each bin whether it is the nearest,
    unless there are more than :data:`MANY_BINS`.

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
            "are seeds alone have none"
        )
    parts = [torch.ones_like(c[..., :1]), c, c.square()]
    if space.size <= MANY_BINS:
        places = space.coordinates.double()
        nearest = torch.cdist(c.flatten(0, -2), places).argmin(-1).view(c.shape[:-1])
        parts.append(torch.nn.functional.one_hot(nearest, len(places)).double())
    return torch.cat(parts, -1)


def level_inputs(space: Any, levels: Levels) -> Tensor:
    """Returns what a belief knows of levels [*B] of a space: float64 [*B, D] on the CPU.

    That is ``space.inputs(levels)``, where there is such a method, or where they lie,
    ``space.locate(levels)``; else D is 0.
    """
    for name in ("inputs", "locate"):
        if hasattr(space, name):
            known: Tensor = getattr(space, name)(levels).double().cpu()
            return known
    return torch.zeros(*levels.shape, 0, dtype=torch.float64)


def for_copies(agent: ActorCritic, levels: Levels) -> Levels:
    """Expands levels [E], which all K Solvers share, to [K, E]; returns [K, E] as they are."""
    return levels.expand(agent.copies, levels.batch_size[-1])


def check_distributions(known: Mapping[str, Any], target: str, measured: Sequence[str]) -> None:
    """Refuses names of distributions that there are not.

    Raises:
        ValueError: naming the key.
    """
    for key, names in (("target", [target]), ("evaluation.distributions", measured)):
        unknown = [name for name in names if name not in known]
        if unknown:
            raise ValueError(f"{key}: must be among {sorted(known)}, got {unknown[0]!r}")


def refuse_many_bins(space: Space) -> None:
    """Refuses a space of more bins than can be counted one by one.

    Raises:
        ArgumentError: if it has more than ``MOST_COUNTED``.
    """
    if space.size > MOST_COUNTED:
        raise ArgumentError(
            f"space: {space.size:,} bins: at most {MOST_COUNTED:,}, each of which is counted; give "
            "its axes fewer, such as bins=1 with rounded=false where a curriculum has that"
        )


def refuse_unfit_bins(space: Space) -> None:
    """Refuses a space in which there is nothing to choose, or too much.

    Raises:
        ValueError: if it has one bin, or see :func:`refuse_many_bins`.
    """
    refuse_many_bins(space)
    if space.size < 2:
        raise ValueError(
            "the space has a single bin, so there is nothing to choose among; give its axes bins"
        )

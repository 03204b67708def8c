"""The contract of a board: levels that can be drawn, and what a Solver does on one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

from proposer_rl.models import ActorCritic
from proposer_rl.task import Levels


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
    """Levels as drawings with one character per cell, and all that a Solver does on one."""

    @property
    def kinds(self) -> Sequence[CellKind]:
        """Of cells, the empty one first."""

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
        """The level [] that is drawn.

        Raises:
            ValueError: if it is none, or none for the Solvers of this task.
        """

    def draw(self, level: Levels) -> list[str]:
        """The drawing of a level [], one text for each row; the inverse of :meth:`read`."""

    def drawing(self, record: Mapping[str, Any]) -> list[str]:
        """The drawing of the level in one of the task's records."""

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

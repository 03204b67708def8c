"""A curriculum decides what the Solver trains on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from tensordict import TensorDictBase

from proposer_rl.learning.ppo import PPO, Update
from proposer_rl.streams import Streams


@dataclass
class Advance:
    """Updates that the Solver has got from a curriculum itself, instead of the cycle's.

    Attributes:
        updates: how many.
        levels: those of the last one, [K, P].
        update: the last one's rollout, [K, P, T], and metrics.
    """

    updates: int
    levels: Any
    update: Update


@dataclass
class Improvement:
    """What a curriculum did before a cycle.

    Attributes:
        metrics: of the cycle, ready for JSON; empty if nothing was done.
        meta_frames: inner environment steps that it cost, beyond the Solver's own.
        advance: None if the Solver is as it was.
    """

    metrics: dict[str, Any] = field(default_factory=dict)
    meta_frames: int = 0
    advance: Advance | None = None


class Curriculum:
    """The interface of curricula; each method does nothing unless a curriculum has use for it.

    A Solver is a :class:`~proposer_rl.learning.ppo.PPO` of a population of K; ``streams`` has the K copies'
    random streams for the present update or cycle.

    Attributes:
        most_solvers: the largest K that it serves; None for any.
        uses_workers: whether it has work for further processes.
    """

    most_solvers: ClassVar[int | None] = None
    uses_workers: ClassVar[bool] = False

    def begin(self) -> None:
        """A fresh Solver begins: forget the last one, but not what was learnt from it."""

    def propose(self, solver: PPO, streams: Sequence[Streams]) -> Any:
        """Levels [K, P] for the Solver's next update."""
        raise TypeError(f"{type(self).__name__} must define propose(solver, streams)")

    def observe(self, levels: Any, rollout: TensorDictBase) -> None:
        """Learn from an update: its levels [K, P] and the Solver's transitions [K, P, T]."""

    def improve(
        self, solver: PPO, streams: Sequence[Streams], pause: Callable[[], None] | None = None
    ) -> Improvement:
        """Prepare for the next cycle, whose first update has not begun.

        Args:
            solver: as it is before the cycle.
            streams: of the cycle.
            pause: to be called now and then by a curriculum that takes long: wherever a repeated
                call, after :meth:`load_state_dict`, would go on from :meth:`state_dict`.
        """
        return Improvement()

    def state_dict(self) -> dict[str, Any]:
        """All that a resumed run needs: nested dicts of tensors, numbers and strings."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put back what :meth:`state_dict` returned."""

    def close(self) -> None:
        """Let go of all that is held outside of this process."""

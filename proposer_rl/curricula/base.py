"""A curriculum decides what the Solver trains on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from proposer_rl.learning import PPO, Update
from proposer_rl.streams import Streams


class Proposal(NamedTuple):
    """What a learner is to train on next.

    Attributes:
        levels: [K, P].
        frames: environment steps that choosing them cost each Solver.
        evaluations: levels on which each Solver was evaluated for it.
    """

    levels: Any
    frames: int = 0
    evaluations: int = 0


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
        metrics: of the cycle, ready for JSON; empty if there is nothing to tell. ``levels`` in it
            are records of the task (:meth:`~proposer_rl.task.Task.record`) by their captions.
        frames: environment steps that it cost each Solver, beyond its own.
        evaluations: levels on which policies were evaluated for it, for each Solver.
        advance: None if the Solver is as it was.
    """

    metrics: dict[str, Any] = field(default_factory=dict)
    frames: int = 0
    evaluations: int = 0
    advance: Advance | None = None


class Curriculum:
    """The interface of curricula; each method does nothing unless a curriculum has use for it.

    A learner is a :class:`~proposer_rl.learning.PPO` of a population of K Solvers; ``streams`` are
    the random streams of each, for the present update or cycle. A curriculum that is made of others
    passes everything on to them.

    Attributes:
        trains_copies: whether it trains copies of the Solver, which other processes can do.
    """

    trains_copies = False

    def begin(self) -> None:
        """A fresh Solver begins: forget the last one, but not what was learnt from it."""

    def propose(self, learner: PPO, updates: int, streams: Sequence[Streams]) -> Proposal:
        """Levels [K, P] for the learner's next update.

        Args:
            learner: as it is.
            updates: how many it has made.
            streams: of the update.
        """
        raise TypeError(f"{type(self).__name__} must define propose(learner, updates, streams)")

    def observe(self, learner: PPO, levels: Any, update: Update) -> None:
        """Learn from an update.

        Args:
            learner: after it.
            levels: [K, P], what it trained on.
            update: the rollout on them [K, P, T], and what the training was like.
        """

    def improve(self, learner: PPO, updates: int, streams: Sequence[Streams]) -> Improvement:
        """Prepare for the next cycle, whose first update has not begun.

        Whatever is raised in it may be followed by :meth:`load_state_dict` and a repeated call.

        Args:
            learner: as it is before the cycle.
            updates: how many it has made.
            streams: of the cycle.
        """
        return Improvement()

    def learnt(self) -> dict[str, Any]:
        """What runs on other Solvers can begin with, part of the state; empty if there is none."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """All that a resumed run needs: nested dicts of tensors, numbers and strings."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put back what :meth:`state_dict` returned."""

    def close(self) -> None:
        """Let go of all that is held outside of this process."""

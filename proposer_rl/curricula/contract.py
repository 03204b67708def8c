"""What you need to write a curriculum: the base class and its batches.

A curriculum proposes levels to a student and observes the results:

    levels = curriculum.propose(student, count, rng)
    outcome = ...                                        # the student trains on the levels
    curriculum.observe(student, batch, outcome)

A curriculum has one student. It observes each level at most once, in the order of the proposals:
the caller's :class:`~proposer_rl.curricula.ledger.Ledger` takes care of that, even if results come
late, in parts or not at all. Several batches may be outstanding, so a curriculum writes into the
``notes`` of a :class:`Batch` what it needs to recognise the levels.

Shapes: n levels in a batch, m of them observed together, T steps, N bins.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase, pad

from proposer_rl.curricula.batches import restored, saved
from proposer_rl.curricula.student import Student
from proposer_rl.learning import first_episode_return, first_episode_success
from proposer_rl.meta.assembly import Components
from proposer_rl.settings import ArgumentError
from proposer_rl.streams import Streams
from proposer_rl.task import Levels


@dataclass(frozen=True)
class Batch:
    """Levels that a curriculum proposed, with notes about them; ``batch[some]`` is a part.

    Attributes:
        levels: [n], on the device of the task.
        notes: a tensordict [n] on the CPU by which the curriculum recognises the levels; None for
            no notes.
        size: number of levels in the whole batch, also of a part; None for n.

    Raises:
        ArgumentError: if the notes are not [n].
    """

    levels: Levels
    notes: TensorDictBase = None
    size: int = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        count = len(self.levels)
        if self.notes is None:
            object.__setattr__(self, "notes", TensorDict({}, [count]))
        if self.size is None:
            object.__setattr__(self, "size", count)
        if self.notes.batch_size[:1] != self.levels.shape[:1]:
            raise ArgumentError(
                f"notes: have shape {list(self.notes.batch_size)}, but must have one for each of "
                f"{count} levels"
            )

    def __len__(self) -> int:
        return len(self.levels)

    def __getitem__(self, index: Any) -> Batch:
        return Batch(self.levels[index], self.notes[index], self.size)


def outcome_of(rollout: TensorDictBase) -> TensorDict:
    """Computes the outcome of levels from a TorchRL rollout [n, T] on them.

    Every outcome is a tensordict [n] with these entries:

    - ``return`` float: undiscounted, of the first episode on the level, or the mean over the
      episodes that a loop played there;
    - ``success`` float in [0, 1]: likewise, if the task has a success;
    - ``episodes`` and ``steps`` int64: how many episodes ended, and the steps of all of them;
    - ``rollout`` [n, T]: if there is one, with ``state_value`` if there is a critic, and with
      ``is_step`` bool [n, T] if episodes are padded to one length;
    - ``score`` float: if the loop itself scores levels.

    Only ``return`` is always there; a curriculum lists the others that it needs in its
    ``required_results``.
    """
    done = rollout["next", "done"].squeeze(-1)
    episodes = done.sum(-1)
    return TensorDict(
        {
            "return": first_episode_return(rollout),
            "success": first_episode_success(rollout).float(),
            "episodes": episodes,
            "steps": rollout.get("is_step", torch.ones_like(done)).sum(-1),
            "rollout": rollout,
        },
        rollout.batch_size[:-1],
    )


def outcome_of_episodes(episodes: Sequence[TensorDictBase]) -> TensorDict:
    """Computes the outcome of levels [m] from one episode [T] on each.

    Shorter episodes are padded with zeros to one rollout [m, T], whose entry ``is_step`` says which
    steps were played.
    """
    longest = max(map(len, episodes))
    filled: list[Any] = [
        episode if len(episode) == longest else pad(episode, [0, longest - len(episode)])
        for episode in episodes
    ]
    return outcome_of(torch.stack(filled))


class Curriculum:
    """The base class of curricula; only :meth:`propose` must be defined.

    Attributes:
        needs: names of the student's functions that it calls; see
            :class:`~proposer_rl.curricula.Student`.
        required_results: entries of an outcome that it needs besides the return: ``success``,
            ``rollout``.
        optional_results: entries of an outcome from which it learns more, where they are told.
        state: names of the attributes that a resumed run needs. They may be numbers, texts,
            tensors, lists and dicts of these, and objects with a ``state_dict``. Override
            :meth:`state_dict` to save anything else.
    """

    needs: tuple[str, ...] = ()
    required_results: tuple[str, ...] = ()
    optional_results: tuple[str, ...] = ()
    state: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def create(cls, run: Components, **settings: Any) -> Curriculum:
        """Makes the curriculum for a run; the command line, ``train`` and ``Teacher`` call it.

        By default the constructor gets the space of the task's levels. Override this method to pass
        on another part of the run: ``return cls(run.task.target, **settings)``.

        Args:
            run: the task, and the Proposer's settings.
            settings: from the configuration. Allowed are the keyword-only arguments of this method
                and, because it has ``**settings``, those of the constructor.
        """
        make: Any = cls
        made: Curriculum = make(run.task.space, **settings)
        return made

    def propose(self, student: Student, count: int, rng: Streams) -> Levels | Batch:
        """Returns levels [n] for the student to train on next, with or without notes.

        Args:
            student: in its current state.
            count: number n of levels, which may differ from call to call.
            rng: named random streams of this proposal, such as ``rng.generator("levels")``.
        """
        raise TypeError(f"{type(self).__name__} must define propose(student, count, rng)")

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Learns from the outcome of a batch, or of a part of it.

        Args:
            student: after it trained on the levels, or while it does.
            batch: the proposed batch or a part of it, m levels in the order of the proposal.
            outcome: a tensordict [m]; see :func:`outcome_of`.
        """

    def log(self) -> dict[str, Any]:
        """Returns what happened since the last call, ready for JSON; empty if nothing did.

        Called after every cycle.
        """
        return {}

    def learnt(self) -> dict[str, Any]:
        """Returns the part of the state that other runs can start from; empty for none."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """Returns all that a resumed run needs, as nested dicts of tensors, numbers and strings."""
        kind: Any = type(self)
        _warn_of_nothing(kind)
        return {name.strip("_"): saved(getattr(self, name)) for name in self.state}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned.

        Raises:
            ArgumentError: if it is the state of another class.
        """
        own = self.state_dict().keys()
        if state.keys() != own:
            raise ArgumentError(
                f"state: has {', '.join(sorted(state)) or 'nothing'}, but {type(self).__name__} "
                f"needs {', '.join(sorted(own)) or 'nothing'}"
            )
        for name in self.state:
            setattr(self, name, restored(state[name.strip("_")], getattr(self, name)))

    def close(self) -> None:
        """Releases resources outside of this process."""


class LearnedCurriculum(Curriculum):
    """The base class of curricula that train something of their own, such as a Proposer.

    Attributes:
        trains_replicas: whether it trains replicas of the student, possibly in other processes.
    """

    trains_replicas: bool = False

    def improve(self, student: Student, rng: Streams) -> dict[str, Any]:
        """Trains before a cycle, and returns metrics as :meth:`Curriculum.log` does.

        After an exception the state may be restored and this method called again.

        Args:
            student: in its state before the cycle.
            rng: named random streams of the cycle.
        """
        return {}


def proposed(curriculum: Curriculum, student: Student, count: int, rng: Streams) -> Batch:
    """Lets a curriculum propose, and returns its levels as a batch.

    Raises:
        ArgumentError: if it does not propose ``count`` levels.
    """
    levels = curriculum.propose(student, count, rng)
    batch = levels if isinstance(levels, Batch) else Batch(levels)
    if len(batch) != count:
        raise ArgumentError(
            f"curriculum={type(curriculum).__name__}: proposes {len(batch)} levels where {count} "
            "were asked for"
        )
    return batch


@functools.cache
def _warn_of_nothing(kind: type[Curriculum]) -> None:
    """Warns once about a class that observes but does not name the state to save."""
    said = kind.state_dict is not Curriculum.state_dict or any(
        "state" in vars(parent) for parent in kind.__mro__ if parent is not Curriculum
    )
    if kind.observe is not Curriculum.observe and not said:
        warnings.warn(
            f"{kind.__name__} observes, but saves nothing for a resumed run: list what to save in "
            "state = (...), or set state = ()",
            stacklevel=3,
        )

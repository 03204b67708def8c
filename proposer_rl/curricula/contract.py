"""The contract of a curriculum: all that its author reads.

A curriculum proposes levels to a student and observes how the student fared on them:

    levels = curriculum.propose(student, count, rng)
    outcome = ...                                        # the student trains on the levels
    curriculum.observe(student, batch, outcome)

It is for one student, and each of its levels is observed at most once, in the order in which they
were proposed: the :class:`~proposer_rl.curricula.ledger.Ledger` of whoever calls it sees to that,
whichever results come late, in parts or not at all. Several batches may be outstanding, so what a
curriculum needs to recognise a level travels in the ``notes`` of a :class:`Batch`.

n levels of a batch, m those of them that are observed together, T steps, N bins.
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
    """Levels that a curriculum has proposed, or a part of them, ``batch[some]``.

    Attributes:
        levels: [n], on the device of the task.
        notes: a tensordict [n] on the CPU, by which the curriculum recognises the levels again;
            None for none.
        size: number of levels of the whole batch, of a part, too; None for n.

    Raises:
        ArgumentError: if there is not one note for each level.
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
    """Returns the outcome of levels, from TorchRL's rollout [n, T] on them.

    Every outcome is a tensordict [n] with

    - ``return`` float: undiscounted, of the first episode on the level, or the mean of those that a
      loop has played there;
    - ``success`` float in [0, 1], where there is such a thing: likewise;
    - ``episodes`` and ``steps`` int64: how many episodes ended, and how long all of it was;
    - ``rollout`` [n, T], where there is one, with ``state_value`` where there is a critic, and
      ``is_step`` bool [n, T] where episodes are filled up to one length;
    - ``score`` float, where the loop itself says how much there is to learn on a level.

    Only ``return`` must be there; a curriculum names others that it cannot do without, its
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
    """Returns the outcome of levels [m] by the one episode [T] that was played on each.

    Shorter episodes are filled up with zeros to one rollout [m, T]; their entry ``is_step`` says
    which steps were played.
    """
    longest = max(map(len, episodes))
    filled: list[Any] = [
        episode if len(episode) == longest else pad(episode, [0, longest - len(episode)])
        for episode in episodes
    ]
    return outcome_of(torch.stack(filled))


class Curriculum:
    """The interface of curricula; of its methods only :meth:`propose` must be defined.

    Attributes:
        needs: names of what it asks of a student; see :class:`~proposer_rl.curricula.Student`.
        required_results: entries of an outcome, beside the return, that it cannot do without:
            ``success``, ``rollout``.
        optional_results: entries that it learns more from where there are any.
        state: names of its attributes that a resumed run needs: numbers, texts, tensors, lists
            and dicts of these, and objects with a state of their own. Others are for
            :meth:`state_dict`.
    """

    needs: tuple[str, ...] = ()
    required_results: tuple[str, ...] = ()
    optional_results: tuple[str, ...] = ()
    state: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def create(cls, run: Components, **settings: Any) -> Curriculum:
        """Makes it for a run, as commands and :class:`~proposer_rl.Teacher` do.

        This one passes on the space of the task's levels. Override it to take something else of
        the run: ``return cls(run.task.target, **settings)``.

        Args:
            run: the task, and the Proposer's settings.
            settings: those that the configuration may have are the keyword-only arguments of this
                method and, as it has ``**settings``, of the constructor.
        """
        make: Any = cls
        made: Curriculum = make(run.task.space, **settings)
        return made

    def propose(self, student: Student, count: int, rng: Streams) -> Levels | Batch:
        """Returns levels [n] for the student to train on next, with notes where it needs any.

        Args:
            student: as it is.
            count: number n of levels; any number, and not always the same.
            rng: named random streams of this proposal, such as ``rng.generator("levels")``.
        """
        raise TypeError(f"{type(self).__name__} must define propose(student, count, rng)")

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Learns from the outcome of a batch or of a part of one.

        Args:
            student: after it has trained on the levels, or while it does.
            batch: as it was proposed, or a part of it, m levels in the order of the proposal.
            outcome: a tensordict [m]; see :func:`outcome_of`.
        """

    def log(self) -> dict[str, Any]:
        """Returns what happened since the last call, ready for JSON; empty if nothing did.

        Its entry ``levels`` has levels [m] by their captions. It is called after every cycle.
        """
        return {}

    def learnt(self) -> dict[str, Any]:
        """Returns the part of the state that runs on other students can begin with, or nothing."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """Returns all that a resumed run needs, in nested dicts of tensors, numbers and strings."""
        kind: Any = type(self)
        _warn_of_nothing(kind)
        return {name.strip("_"): saved(getattr(self, name)) for name in self.state}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Puts back what :meth:`state_dict` returned.

        Raises:
            ArgumentError: if that was the state of another class.
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
        """Releases what is held outside of this process."""


class LearnedCurriculum(Curriculum):
    """A curriculum that trains something before a cycle, such as a Proposer or one of its parts.

    Attributes:
        trains_replicas: whether it trains replicas of the student, which other processes can do.
    """

    trains_replicas: bool = False

    def improve(self, student: Student, rng: Streams) -> dict[str, Any]:
        """Prepares for the next cycle, and returns metrics of it as :meth:`Curriculum.log` does.

        If it raises, :meth:`Curriculum.load_state_dict` and another call may follow.

        Args:
            student: as it is before the cycle.
            rng: named random streams of the cycle.
        """
        return {}


def proposed(curriculum: Curriculum, student: Student, count: int, rng: Streams) -> Batch:
    """Lets a curriculum propose, and returns its levels as a batch, with or without notes.

    Raises:
        ArgumentError: if they are not ``count`` levels.
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
    """Warns, once, of a class that observes and does not say what of that is to be saved."""
    said = kind.state_dict is not Curriculum.state_dict or any(
        "state" in vars(parent) for parent in kind.__mro__ if parent is not Curriculum
    )
    if kind.observe is not Curriculum.observe and not said:
        warnings.warn(
            f"{kind.__name__} observes, but a resumed run begins anew: name the attributes to be "
            "saved, state = (...), or () for none",
            stacklevel=3,
        )

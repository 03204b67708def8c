"""The contract of a curriculum: all that its author reads.

A curriculum proposes levels to a student and observes how the student fared on them:

    batch = curriculum.propose(student, count, streams)
    outcome = ...                                        # the student trains on batch.levels
    curriculum.observe(student, batch, outcome)

Nothing hides between the two calls. What a curriculum will need to recognise a level travels in
``batch.notes``, so that any number of batches may be outstanding and may come back in any order, in
parts (``batch[:, some]``), or not at all. Where the order could matter, an :class:`Inbox` puts what
was observed aside and hands it out in the order of the proposals. Then two outstanding batches, the
second of which comes back first, teach exactly what one after the other would.

K are students that train side by side, each from random streams of its own, n levels of a batch,
T steps, N bins. A loop that trains one student has K = 1.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula.batches import levels_at, packed, restored, saved, unpacked
from proposer_rl.curricula.student import Student
from proposer_rl.learning import first_episode_return, first_episode_success
from proposer_rl.meta.assembly import Components
from proposer_rl.streams import Streams
from proposer_rl.task import Levels

PATIENCE = 32
"""Newer batches that are proposed before one is taken as complete, some of which may be lost.

Where episodes go on, a level may be two of them on its way, its own and the one before; the longest
that come with a task are 1600 steps, 13 updates of 128.
"""


@dataclass(frozen=True)
class Batch:
    """Levels that a curriculum has proposed, or a part of them, ``batch[:, some]``.

    Attributes:
        levels: [K, n], on the device of the task.
        notes: a tensordict [K, n] on the CPU, by which the curriculum recognises the levels again;
            None for none.

    Raises:
        ValueError: if there is not one note for each level.
    """

    levels: Levels
    notes: TensorDictBase = None

    def __post_init__(self) -> None:
        if self.notes is None:
            object.__setattr__(self, "notes", TensorDict({}, self.levels.shape[:2]))
        if self.levels.shape[:2] != self.notes.batch_size:
            raise ValueError(
                f"levels {list(self.levels.shape[:2])} and notes {list(self.notes.batch_size)} of "
                "a batch must have one shape [K, n]"
            )

    @property
    def count(self) -> int:
        """The number n of levels of each student."""
        return int(self.notes.batch_size[1])

    def __getitem__(self, index: Any) -> Batch:
        return Batch(self.levels[index], self.notes[index])

    def keep(self, index: Tensor) -> Batch:
        """Returns the batch as if only these levels had been proposed.

        Args:
            index: places of the levels that are kept, in their new order, int64 [K, m].
        """
        notes = levels_at(self.notes, index)
        _renumber(notes, torch.ones(notes.batch_size, dtype=torch.bool))
        return Batch(levels_at(self.levels, index), notes)


def outcome_of(rollout: TensorDictBase) -> TensorDict:
    """Returns the outcome of levels, from TorchRL's rollout [K, n, T] or [n, T] on them.

    Every outcome is a tensordict [K, n] with

    - ``return`` float: undiscounted, of the first episode on the level, or the mean of those that a
      loop has played there;
    - ``success`` float in [0, 1], where there is such a thing: likewise;
    - ``episodes`` and ``steps`` int64: how many episodes ended, and how long all of it was;
    - ``rollout`` [K, n, T], where there is one, with ``state_value`` where there is a critic, and
      ``is_step`` bool [K, n, T] where episodes are filled up to one length;
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


class Curriculum:
    """The interface of curricula; of its methods only :meth:`propose` must be defined.

    ``streams`` are the random streams of the K students, for the present proposal.

    Attributes:
        needs: names of what it asks of a student; see :class:`~proposer_rl.curricula.Student`.
        required_results: entries of an outcome, beside the return, that it cannot do without:
            ``success``, ``rollout``.
        state: names of its attributes that a resumed run needs: numbers, texts, tensors, lists
            and dicts of these, and objects with a state of their own. Others are for
            :meth:`state_dict`.
    """

    needs: tuple[str, ...] = ()
    required_results: tuple[str, ...] = ()
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

    def propose(self, student: Student, count: int, streams: Sequence[Streams]) -> Batch:
        """Returns levels for the students to train on next.

        Args:
            student: as it is.
            count: number n of levels of each; any number, and not always the same.
            streams: of this proposal, K of them.
        """
        raise TypeError(f"{type(self).__name__} must define propose(student, count, streams)")

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Learns from the outcome of a batch or of a part of one.

        Args:
            student: after it has trained on the levels, or while it does.
            batch: as it was proposed, or a part of it.
            outcome: a tensordict [K, n]; see :func:`outcome_of`.

        Raises:
            ValueError: if the outcome does not fit the batch; then nothing has changed.
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
        """Puts back what :meth:`state_dict` returned."""
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

    def improve(self, student: Student, streams: Sequence[Streams]) -> dict[str, Any]:
        """Prepares for the next cycle, and returns metrics of it as :meth:`Curriculum.log` does.

        If it raises, :meth:`Curriculum.load_state_dict` and another call may follow.

        Args:
            student: as it is before the cycle.
            streams: of the cycle, K of them.
        """
        return {}


class Inbox:
    """Evidence on levels, which comes in any order and is given back in the order of proposal.

    It numbers batches and the places of their levels in the notes (``number``, ``place``, and the
    ``size`` n of the batch, each int64 [K, n]), keeps what curricula reduce an outcome to, and
    hands it out sorted. A curriculum takes it at its next proposal and when it logs, so that
    between two proposals the order of returns has no effect.

    Args:
        like: a level of the kind that ``level`` in the evidence holds; None if there is none.
    """

    def __init__(self, like: Levels | None = None) -> None:
        self._like = like
        self._next = 0
        self._parts: list[TensorDict] = []  # [K, m]

    def batch(self, levels: Levels, **notes: Tensor) -> Batch:
        """Makes a batch of levels [K, n], with the next number and these notes [K, n]."""
        students, count = levels.shape[:2]
        number = torch.full((students, count), self._next)
        self._next += 1
        every = {**notes, "number": number, **_places(torch.ones_like(number, dtype=torch.bool))}
        return Batch(levels, TensorDict(every, (students, count)))

    def check(self, batch: Batch, outcome: TensorDictBase) -> None:
        """Checks an outcome before anything is made of it, which waits for the device.

        Raises:
            ValueError: if a number in it is not finite, or the batch is none of this curriculum's,
                or some of it was observed before and has not been taken yet.
        """
        for name in {"return", "success", "score"} & {*outcome.keys()}:
            if not bool(outcome[name].isfinite().all()):
                raise ValueError(f"the outcome's {name} is not finite on every level")
        notes = batch.notes
        if not batch.count:
            return
        number, places = int(notes["number"][0, 0]), set(notes["place"][0].tolist())
        if bool((notes["number"] != number).any()) or not 0 <= number < self._next:
            raise ValueError(
                f"levels of batch {number}: an outcome is of one batch, and {self._next} have been "
                "proposed"
            )
        waiting = [part for part in self._parts if int(part["number"][0, 0]) == number]
        seen = [place for part in waiting for place in part["place"][0].tolist()]
        if len(places) < batch.count or places & {*seen}:
            raise ValueError(f"levels of batch {number} have been observed before")

    def put(self, batch: Batch, **evidence: Any) -> None:
        """Keeps evidence [K, n] on a batch, or on a part of one."""
        if batch.count:
            where = batch.notes.select("number", "place", "size")
            part = TensorDict({**where, **evidence}, batch.notes.batch_size, device="cpu")
            self._parts.append(part)

    def take(self, whole: bool = False) -> list[TensorDict]:
        """Returns the evidence that has come in, a tensordict [K, m] for each batch in their order.

        Args:
            whole: whether parts stay until their batch is complete, and later batches with them.
                Once :data:`PATIENCE` newer ones have been proposed, it is taken as it is.
        """
        batches: dict[int, list[TensorDict]] = {}
        for part in self._parts:
            batches.setdefault(int(part["number"][0, 0]), []).append(part)
        taken, self._parts = [], []
        for number in sorted(batches):
            parts = batches[number]
            evidence: Any = torch.cat(parts, 1) if len(parts) > 1 else parts[0]
            waits = whole and self._next - 1 - number < PATIENCE
            if self._parts or (waits and evidence.shape[1] < int(evidence["size"][0, 0])):
                self._parts += parts
            elif bool((evidence["place"].diff() > 0).all()):
                taken.append(evidence)
            else:
                taken.append(levels_at(evidence, evidence["place"].argsort(1)))
        return taken

    def state_dict(self) -> dict[str, Any]:
        """Returns the next number, and the evidence that has not been taken."""
        return {"next": self._next, "parts": [packed(part) for part in self._parts]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Puts back what :meth:`state_dict` returned."""
        self._next = int(state["next"])
        self._parts = [unpacked(part, self._like) for part in state["parts"]]


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


def _places(own: Tensor) -> dict[str, Tensor]:
    """Numbers the levels of a batch [K, n] that are its curriculum's own, bool [K, n]."""
    return {"place": own.cumsum(1) - 1, "size": own.sum(1, keepdim=True).expand_as(own)}


def _renumber(notes: TensorDictBase, own: Tensor) -> None:
    """Counts the places of all numbered notes [K, n] anew, also of nested ones.

    Args:
        notes: of a curriculum, and in them of those that it is made of; of a mixture these are
            named by the numbers in ``part``.
        own: the levels that it has proposed, bool [K, n]; in a mixture not all of them.
    """
    if "place" in notes.keys():
        notes.update(_places(own))
    mixed = "part" in notes.keys()
    for name, within in notes.items():
        if isinstance(within, TensorDictBase):
            _renumber(within, own & (notes["part"] == int(name)) if mixed else own)

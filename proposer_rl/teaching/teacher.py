"""The teacher: a curriculum in any training loop, which asks for levels and tells results."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from secrets import token_hex
from threading import RLock
from typing import Any, Literal, SupportsIndex

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.utils._pytree import tree_map_only

from proposer_rl.curricula import Curriculum, Student, require
from proposer_rl.curricula.batches import CPU, moved, packed, saved
from proposer_rl.curricula.contract import proposed
from proposer_rl.curricula.ledger import OUT, OVER, RETURNED, Block, Ledger
from proposer_rl.models import check_torch_defaults
from proposer_rl.recipes import Recipe
from proposer_rl.runs.folder import storage
from proposer_rl.settings import ArgumentError, Count, checked, whole
from proposer_rl.streams import Streams
from proposer_rl.task import Levels, Task
from proposer_rl.teaching.identity import of_levels, require_same
from proposer_rl.teaching.making import adapted, make_curriculum
from proposer_rl.teaching.numbers import as_ids
from proposer_rl.teaching.remote import TeacherClient, TeacherServer
from proposer_rl.teaching.results import (
    LEVEL_ID,
    RESULTS,
    as_outcome,
    as_result,
    ended,
    results_of,
    results_of_rollout,
)
from proposer_rl.teaching.spaces import LevelSpace, in_default_dtype
from proposer_rl.teaching.tally import Tally

HOW = {  # to give results that are missing
    "success": "tell it of every level, also of failures, as with tell(..., success=), or give "
    'success="terminated" to LevelTransform, TaughtEnv or, for rollouts, Teacher',
    "rollout": "give rollouts to observe(), as with LevelTransform(tell=False)",
}
LEAST_BLOCK, LARGEST_BLOCK = 32, 384  # tickets, where the loop does not say how many
PLAIN = ("levels_told", "scored", "proposals", "proposed", "at")  # attributes in a state
Success = Literal["terminated", "truncated"] | Callable[[TensorDictBase], Tensor]


class Teacher:
    """Chooses the levels that your training loop plays, and learns from the results.

    In batches, one after another:

        levels = teacher.propose(32)
        teacher.observe({"return": returns, "success": success})

    Or by tickets, of which any number may be out; they come back in any order, in parts, or never:

        ticket, level = teacher.ask()            # or ids, levels = teacher.ask(4096)
        teacher.tell(ticket, return_=r, success=ok)

    The curriculum proposes a block of levels at once, and observes the results that came in the
    meantime just before it does so. A refused call has no effect.

    Args:
        curriculum: ``prl.curricula.NAME(...)``, its name, or a curriculum of your own: an object,
            or a class, of which ``create`` makes one.
        space: :class:`~proposer_rl.teaching.Parameters`, :class:`~proposer_rl.teaching.Items`,
            :class:`~proposer_rl.teaching.LevelGenerator`,
            :class:`~proposer_rl.teaching.MadeLevels`, or a task.
        seed: seed of all random draws.
        device: device of the levels and tickets that the loop gets.
        filter: filter of the proposed levels, as of :func:`proposer_rl.train`.
        block: number of levels that the curriculum proposes at once. None for as many as the loop
            has out at that moment, from 32 to 384; never fewer than it asks for.
        success: what counts as a success in rollouts that have no entry ``success``:
            ``"terminated"``, ``"truncated"``, or a function of their ``next``. None if nothing
            does, as where termination may be a failure.
        student: what the curriculum can ask about the learner; None for the functions in ``can``.
        can: functions of :class:`~proposer_rl.curricula.Student`, by their names. Of these,
            ``performance``, ``exact_performance``, ``optimal_return`` and ``play`` get levels [n]
            as :meth:`propose` returns them.

    Attributes:
        id: a text that identifies the teacher in logs; a checkpoint keeps it.

    Raises:
        ArgumentError: naming the argument.
        UnfitStudentError: naming the function that the curriculum needs, and how to give it.

    Example:
        >>> import proposer_rl as prl
        >>> space = prl.Parameters({"gravity": (5.0, 25.0), "walls": range(60)}, bins=4)
        >>> teacher = prl.Teacher(prl.curricula.plr(score="regret"), space)
        >>> ticket, level = teacher.ask()
        >>> sorted(level), teacher.tell(ticket, return_=0.5)
        (['gravity', 'walls'], None)
    """

    _block: Block | None  # whose tickets are being handed out
    _at: int  # the next of these tickets
    _counted: int  # the first of them that the log has not counted
    _rows: list[Any]  # the block's levels one by one, once they were asked for
    _moved: Any  # the block's levels on the loop's device, likewise

    @torch.inference_mode(False)
    @checked
    def __init__(
        self,
        curriculum: Recipe | Curriculum | type[Curriculum] | str,
        space: LevelSpace | Task,
        *,
        seed: SupportsIndex = 0,
        device: str | torch.device = "cpu",
        filter: Mapping[str, Any] | str | None = None,
        block: Count | None = None,
        success: Success | None = None,
        student: Student | None = None,
        **can: Any,
    ) -> None:
        check_torch_defaults()
        self.space, self.device, self.block = space, torch.empty(0, device=device).device, block
        self.id = token_hex(4)
        self._seed = whole("seed", seed)
        self.curriculum, self._made_of = make_curriculum(curriculum, space, filter, self._seed)
        given = self._given = getattr(space, "given", in_default_dtype)
        self._rows_of = getattr(space, "rows", lambda levels: [*given(levels)])
        self._success = success
        self.student = student or Student(
            **{name: adapted(name, one, given, self.device) for name, one in can.items()}
        )
        named = curriculum if isinstance(curriculum, str) else getattr(curriculum, "name", None)
        require(self.student, self.curriculum.needs, named or type(self.curriculum).__name__)
        kinds = {**dict.fromkeys(RESULTS, float), "rollout": object}
        self._ledger, self._tally = Ledger(kinds), Tally(space)
        self._scored: bool | None = None  # whether results have a score; None before any
        self._with_success: bool | None = None  # whether they have a success, likewise
        self._warned = False  # of a missing success
        self._proposals = self._levels_told = 0  # the latter up to the last log()
        self._proposed: list[int] = []  # first tickets of the batches that propose() returned
        self._block, self._counted = None, 0
        self._use(None, 0)
        self._kept: TensorDictBase | None = None  # steps [L] of rollouts' unfinished episodes
        self._lock, self._process = RLock(), os.getpid()
        self._server: TeacherServer | None = None

    @property
    def required_results(self) -> tuple[str, ...]:
        """Returns what results must have beside the return: ``success``, ``rollout``."""
        return self.curriculum.required_results

    def propose(self, n: SupportsIndex) -> Any:
        """Returns levels [n], whose results :meth:`observe` takes together."""
        with self._here():
            block = self._next(whole("n", n, 1))
            block.state[:] = OUT
            self._proposed.append(block.start)
            self._tally.count(block.batch.levels)
            return self._levels(block)

    def ask(self, n: SupportsIndex | None = None) -> tuple[Any, Any]:
        """Returns the next level, or the next ``n``, with the tickets by which to tell results.

        Args:
            n: number of levels; None for a single one.

        Returns:
            Tickets int64 [n] and levels [n], on the teacher's device. For a single one a ticket and
            a level, whose parameters are numbers and texts of Python's.
        """
        with self._here():
            if n is None:
                return self._one()
            left = whole("n", n, 0)
            ids: list[Tensor] = []
            levels: list[Any] = []
            while left or not ids:
                block, start = self._current(left), self._at
                self._at = end = min(start + left, block.end)
                which = slice(start - block.start, end - block.start)
                block.state[which] = OUT
                ids.append(torch.arange(start, end, device=self.device))
                if self._moved is None:
                    self._moved = self._levels(block)
                levels.append(self._moved[which])
                left -= end - start
            if len(ids) == 1:
                return ids[0], levels[0]
            return torch.cat(ids), torch.cat(levels)

    def tell(
        self,
        ids: Any,
        return_: Any,
        success: Any = None,
        *,
        score: Any = None,
        episodes: Any = None,
        steps: Any = None,
    ) -> None:
        """Takes the results of levels.

        Args:
            ids: a ticket, or tickets [n] in any order.
            return_: undiscounted return of an episode on each level, or the mean of several: a
                number, or numbers [n].
            success: whether the episode was a success, or the share of several that were, from 0 to
                1. Curricula use it where all levels that they observe together have one.
            score: how much there is to learn on the level, if the loop computes that itself, such
                as the mean of the absolute advantages; for curricula that score levels. Give it for
                all levels or for none.
            episodes: number of episodes on each level, or one number for all tickets; None for 1.
            steps: number of steps that these took together, likewise.

        Raises:
            ArgumentError: naming the argument, for a ticket that is not out, a number that is
                missing or not finite, or another shape.
        """
        given = (return_, success, score, episodes, steps)
        pairs = zip(RESULTS, given, strict=True)
        with self._here():
            self._tell(ids, {n: one for n, one in pairs if one is not None or n == "return"})

    def predicted(self, ids: Any) -> NDArray[np.float64] | None:
        """Returns the success that the curriculum predicted for levels when it proposed them.

        Args:
            ids: tickets [n] that are out.

        Returns:
            [n]; None if the curriculum makes no predictions.

        Raises:
            ArgumentError: for a ticket that is not out.
        """
        with self._here():
            tickets = as_ids("ids", ids)
            found = np.full(len(tickets), np.nan)
            for block, which, place in self._ledger.find(tickets):
                if "predicted" not in block.batch.notes.keys():
                    return None
                found[which] = block.batch.notes["predicted"][place]
            return found

    def done_with(self, ids: Any) -> NDArray[np.bool_]:
        """Returns which tickets [n] were told or dropped, [n]."""
        with self._here():
            return np.isin(self._ledger.states(as_ids("ids", ids)), (RETURNED, OVER))

    def drop(self, ids: Any = None) -> None:
        """Gives up levels that will have no results, such as those of interrupted episodes.

        Args:
            ids: tickets, some of which may have been told or dropped already; None for all that are
                out, as where a resumed loop begins new episodes.
        """
        with self._here():
            if ids is None:
                dropped = self._ledger.out
                self._ledger.drop_all()
                self._proposed.clear()
            else:
                tickets = as_ids("ids", ids)
                going = tickets[~self.done_with(tickets)]
                self._ledger.drop(self._ledger.find(going))
                dropped = len(going)
            self._tally.dropped(dropped)

    @torch.inference_mode(False)
    def observe(self, outcome: Any, ids: Any = None) -> None:
        """Takes the results of proposed levels, or of the levels of some tickets.

        Args:
            outcome: results by name, ``return`` and perhaps others of :meth:`tell`, each [n]. Or a
                rollout [*B, T] with the ``level_id`` of a
                :class:`~proposer_rl.teaching.LevelTransform`: each episode that ends in it counts
                for the level that it began on, also in an earlier rollout. For a rollout [n, T]
                each row of which begins with a reset on its level, give
                :func:`outcome_of(rollout) <proposer_rl.curricula.outcome_of>`.
            ids: the tickets; None for the levels of :meth:`propose`, if one batch is out.

        Raises:
            ArgumentError: as of :meth:`tell`; if ``ids`` is None while several batches are out.
        """
        with self._here():
            if isinstance(outcome, TensorDictBase) and "next" in outcome.keys():
                kept = self._kept
                if kept is not None:  # without episodes that were dropped since
                    states = self._ledger.states(as_ids("ids", kept[LEVEL_ID].reshape(-1)))
                    kept = kept[torch.from_numpy(states == OUT).to(kept[LEVEL_ID].device)]
                tickets, whole, left = ended(outcome, kept)
                if len(tickets):
                    self._tell(tickets, results_of_rollout(whole, self._success))
                self._kept = left
                return
            tickets = self._last_proposed() if ids is None else as_ids("ids", ids)
            self._tell(tickets, results_of(outcome, self._success))
            if ids is None:
                self._proposed.clear()

    @torch.inference_mode(False)
    def log(self, file: str | os.PathLike[str] | None = None) -> dict[str, Any]:
        """Returns what happened since the last call, and the curriculum's own log.

        For every curriculum: the numbers of levels that were ``proposed``, ``told`` and
        ``dropped``, and that are ``out`` now; ``mean_return`` and ``mean_success`` of the results,
        None without any; and ``drawn``, the number of proposed levels in each bin of each
        parameter. The curriculum's own entries do not include results since the last proposal.

        Args:
            file: a file of JSON Lines to append a line to, for ``bin/report``. The line has the
                teacher's ``id`` as ``teacher`` and ``levels_told`` since it began.

        Raises:
            StorageError: if the file cannot be written.
        """
        with self._here():
            self._count()
            record = {**self.curriculum.log(), **self._tally.read(self._ledger.out)}
            self._levels_told += record["told"]
            if file is not None:
                kept = {"teacher": self.id, "levels_told": self._levels_told, **record}
                with storage(Path(file)), open(file, "a", encoding="utf-8") as lines:
                    lines.write(json.dumps(kept) + "\n")
            return record

    @torch.inference_mode(False)
    def state_dict(self) -> dict[str, Any]:
        """Returns the state for a checkpoint, including the tickets that are out."""
        with self._here():
            kept = self._kept
            return {
                "of": self._of,
                "id": self.id,
                "curriculum": self.curriculum.state_dict(),
                "ledger": self._ledger.state_dict(),
                "block": None if self._block is None else self._block.start,
                **{name: saved(getattr(self, f"_{name}")) for name in PLAIN},
                "rollout": None if kept is None else packed(kept),
            }

    @torch.inference_mode(False)
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Loads what :meth:`state_dict` returned, whichever device its tensors are on.

        Raises:
            ArgumentError: if the state belongs to another space, curriculum or setting, naming what
                differs; if levels of this teacher are out, as after environments have been reset.
                The call then has no effect.
        """
        with self._here():
            state = tree_map_only(Tensor, Tensor.cpu, state)
            for what, now in self._of.items():
                require_same(what, state["of"][what], now)
            if self._ledger.out:
                raise ArgumentError(
                    "state: levels of this teacher are still out; load it before collectors and "
                    "environments begin, or call drop() and reset the environments"
                )
            self.id = state["id"]
            for name in PLAIN:
                setattr(self, f"_{name}", saved(state[name]))
            self.curriculum.load_state_dict(state["curriculum"])
            self._ledger.load_state_dict(state["ledger"], self._like)
            blocks = {block.start: block for block in self._ledger.blocks}
            self._block, self._tally = None, Tally(self.space)
            self._use(blocks.get(state["block"]), self._at)
            kept = state["rollout"]
            self._kept = None if kept is None else TensorDict.from_dict(dict(kept), batch_dims=1)

    def diverge(self, number: int) -> None:
        """Makes this teacher draw other levels, from the next one on, than its copies do.

        Call it in each of several processes that made or loaded the same teacher, with a number of
        its own, such as its rank. 0 changes nothing.
        """
        with self._here():
            if number:
                self._seed += number
                if self._block is not None:
                    self._block.state[self._at - self._block.start :] = OVER
                self._use(None, 0)

    @cached_property
    def _like(self) -> Levels:
        """Returns one level of the space."""
        source: Any = self.space.space
        return source.sample(1, torch.Generator())[0]

    @cached_property
    def _of(self) -> dict[str, Any]:
        """Describes the space and the curriculum that a state belongs to."""
        return {"space": of_levels(self.space, self._like), "curriculum": self._made_of}

    def client(self) -> TeacherClient:
        """Returns a client to send to another process, such as a collector's worker.

        It has ``ask``, ``tell`` and ``drop``.
        """
        with self._here():
            self._server = self._server or TeacherServer(self)
            return self._server.client()

    def __reduce__(self) -> Any:
        raise TypeError(
            "a teacher cannot be copied into another process, where it would be a second one; send "
            "teacher.client() instead"
        )

    def _here(self) -> RLock:
        if os.getpid() != self._process:
            raise RuntimeError(
                "this is a forked process's copy of a teacher; give that process teacher.client()"
            )
        return self._lock

    def _one(self) -> tuple[int, Any]:
        block, ticket = self._current(1), self._at
        self._at += 1
        block.state[ticket - block.start] = OUT
        if not self._rows:
            self._rows = self._rows_of(moved(block.batch.levels, CPU).clone())
        return ticket, self._rows[ticket - block.start]

    def _current(self, left: int) -> Block:
        """Returns the block of the next ``left`` tickets, a new one if the last is used up."""
        block = self._block
        if block is None or (left and self._at == block.end):
            # Bounded, since a loop may lose tickets, which then stay out.
            fitting = min(max(self._ledger.out + left, LEAST_BLOCK), LARGEST_BLOCK)
            block = self._next(max(self.block or fitting, left))
            self._use(block, block.start)
        return block

    def _use(self, block: Block | None, at: int) -> None:
        """Switches to a block, whose tickets are handed out from ``at`` on."""
        self._count()
        self._block, self._at, self._counted = block, at, at
        self._rows, self._moved = [], None

    def _count(self) -> None:
        """Counts for the log which levels of the block were handed out."""
        block = self._block
        if block is not None and self._at > self._counted:
            some = slice(self._counted - block.start, self._at - block.start)
            self._tally.count(block.batch.levels[some])
            self._counted = self._at

    @torch.inference_mode(False)
    def _next(self, count: int) -> Block:
        """Lets the curriculum observe the results that came, and returns its next proposal."""
        check_torch_defaults()
        for batch, results in self._ledger.take():
            self.curriculum.observe(self.student, batch, as_outcome(results))
        rng = Streams(self._seed, "update", self._proposals)
        batch = proposed(self.curriculum, self.student, count, rng)
        self._proposals += 1
        return self._ledger.add(batch)

    def _levels(self, block: Block) -> Any:
        """Returns a copy of a block's levels as the loop gets them."""
        return self._given(moved(block.batch.levels, self.device).clone())

    def _tell(self, ids: Any, given: Mapping[str, Any]) -> None:
        """Notes the results of a ticket or of tickets [n], and warns once of a missing success."""
        for name in self.required_results:
            if name not in given:
                raise ArgumentError(f"{name}: missing: this curriculum requires it; {HOW[name]}")
        single = type(ids) is int
        tickets = np.array([ids]) if single else as_ids("ids", ids)
        shape = () if single else (len(tickets),)
        results = {name: as_result(name, value, shape) for name, value in given.items()}
        scored, known = "score" in results, "success" in results
        if self._scored not in (None, scored):
            how = "missing: other levels were told with one" if self._scored else "others had none"
            raise ArgumentError(f"score: {how}; give it for all or for none")
        if single:
            self._ledger.tell_one(ids, results)
        else:
            self._ledger.tell(self._ledger.find(tickets), results)
        self._tally.returned(len(tickets), results["return"], results.get("success"))
        self._scored = scored
        if self._warned:
            return
        if not known and "success" in self.curriculum.optional_results:
            missing = "missing: this curriculum learns more from success than from returns"
        elif self._with_success not in (None, known):
            missing = "told of some levels only, where curricula ignore it"
        else:
            self._with_success = known
            return
        self._warned = True
        warnings.warn(f"success: {missing}; {HOW['success']}", stacklevel=3)

    def _last_proposed(self) -> NDArray[np.int64]:
        """Returns the tickets of the only batch that is out."""
        blocks = self._ledger.blocks
        out = [block for block in blocks if block.start in self._proposed and OUT in block.state]
        if len(out) != 1:
            how = f"{len(out)} batches are out" if out else "nothing is out"
            raise ArgumentError(
                f"ids: missing: {how}; without tickets observe() takes the results of the last "
                "propose(); for several batches at once use ask(n) and its tickets"
            )
        return np.arange(out[0].start, out[0].end)

"""The teacher: a curriculum in any loop, which takes levels and brings results."""

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
from proposer_rl.curricula.batches import CPU, moved, packed
from proposer_rl.curricula.contract import outcome_of_episodes, proposed
from proposer_rl.curricula.ledger import OUT, OVER, RETURNED, Block, Ledger
from proposer_rl.models import check_torch_defaults
from proposer_rl.recipes import Recipe
from proposer_rl.runs.folder import storage
from proposer_rl.settings import ArgumentError, Count, checked, whole
from proposer_rl.streams import Streams
from proposer_rl.task import Levels, Task
from proposer_rl.teaching.abilities import adapted
from proposer_rl.teaching.identity import of_levels, require_same
from proposer_rl.teaching.making import make_curriculum
from proposer_rl.teaching.numbers import as_ids
from proposer_rl.teaching.remote import TeacherClient, TeacherServer
from proposer_rl.teaching.results import (
    LEVEL_ID,
    RESULTS,
    as_outcome,
    as_result,
    by_name,
    ended,
    outcome_of_rollout,
)
from proposer_rl.teaching.spaces import LevelSpace, in_default_dtype
from proposer_rl.teaching.tally import Tally

LEAST_BLOCK, LARGEST_BLOCK = 32, 384  # tickets, where the loop does not say how many
Success = Literal["terminated", "truncated"] | Callable[[TensorDictBase], Tensor]


class Teacher:
    """Proposes the levels of a space by a curriculum, and observes what came of them.

    In batches, one after another:

        levels = teacher.propose(32)
        teacher.observe({"return": returns, "success": success})

    Or by tickets, of which any number may be out; they come back in any order, in parts, or never:

        ticket, level = teacher.ask()            # or ids, levels = teacher.ask(4096)
        teacher.tell(ticket, return_=r, success=ok)

    The curriculum observes results when it proposes next, which it does for a block of tickets at
    once. A refused call has no effect.

    Args:
        curriculum: ``prl.curricula.NAME(...)``, its name, or a curriculum of one's own or its
            class, which is then made by its ``create``.
        space: :class:`~proposer_rl.teaching.Parameters`, :class:`~proposer_rl.teaching.Items`,
            :class:`~proposer_rl.teaching.LevelGenerator`, or a task.
        seed: of every random draw.
        device: where levels and tickets are given.
        filter: of the proposed levels, as of :func:`proposer_rl.train`.
        block: number of tickets that the curriculum proposes at once. None for as many as the loop
            has out at that moment, from 32 to 384, and never fewer than it asks for.
        success: what in a rollout is a success where it has no such entry: ``"terminated"``,
            ``"truncated"``, or a function of its ``next``; None where termination may be a failure.
        student: what the curriculum may ask of; None for one that can do what ``can`` says.
        can: functions by their names, as of :class:`~proposer_rl.curricula.Student`, of which
            ``performance``, ``exact_performance``, ``optimal_return`` and ``play`` are called with
            levels [n] as :meth:`propose` gives them.

    Attributes:
        id: a text that no other teacher has; a checkpoint keeps it, and each line of a log.

    Raises:
        ArgumentError: naming the argument.
        UnfitStudentError: naming what the curriculum needs of the student, and how to give it.

    Example:
        >>> import proposer_rl as prl
        >>> space = prl.Parameters({"gravity": (5.0, 25.0), "walls": range(60)}, bins=4)
        >>> teacher = prl.Teacher(prl.curricula.plr(score="regret"), space)
        >>> ticket, level = teacher.ask()
        >>> sorted(level), teacher.tell(ticket, return_=0.5)
        (['gravity', 'walls'], None)
    """

    _block: Block | None  # that tickets are handed out from
    _at: int  # the next of them
    _counted: int  # the next that the log has not counted
    _rows: list[Any]  # its levels one by one, from the first time on
    _moved: Any  # its levels as the loop gets them, likewise

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
        if hasattr(space, "space"):
            self._like  # noqa: B018  what is wrong with one's own levels is told of these
        self.curriculum, self._made_of = make_curriculum(curriculum, space, filter, self._seed)
        if student is not None and can:
            raise ArgumentError(f"{next(iter(can))}: give it to the student, which is asked alone")
        given = getattr(space, "given", in_default_dtype)
        self.student = student or Student(
            **{name: adapted(name, one, given, self.device) for name, one in can.items()}
        )
        named = curriculum if isinstance(curriculum, str) else getattr(curriculum, "name", None)
        require(self.student, self.curriculum.needs, named or type(self.curriculum).__name__)
        self._given = given
        self._rows_of = getattr(space, "rows", lambda levels: [*given(levels)])
        self._success = success
        kinds = {**dict.fromkeys(RESULTS, float), "rollout": object}
        self._ledger, self._tally = Ledger(kinds), Tally(space)
        self._scored: bool | None = None  # whether results come with a score; None before any
        self._with_success: bool | None = None  # whether they came with a success
        self._warned = False  # of success
        self._proposals = self._levels_told = 0  # the latter up to the last log()
        self._whole: list[int] = []  # first tickets of what propose() has given
        self._block, self._counted = None, 0
        self._use(None, 0)
        self._kept: TensorDictBase | None = None  # steps [L] of episodes that have not ended
        self._lock, self._process = RLock(), os.getpid()
        self._server: TeacherServer | None = None

    @property
    def required_results(self) -> tuple[str, ...]:
        """Names of what results must have beside the return: ``success``, ``rollout``."""
        return self.curriculum.required_results

    def propose(self, n: SupportsIndex) -> Any:
        """Returns levels [n] to be observed together."""
        with self._here():
            block = self._next(whole("n", n, 1))
            block.state[:] = OUT
            self._whole.append(block.start)
            self._tally.count(block.batch.levels)
            return self._levels(block)

    def ask(self, n: SupportsIndex | None = None) -> tuple[Any, Any]:
        """Hands out the next level and its ticket.

        Args:
            n: None for one level, as Python's numbers where the space has such; else so many.

        Returns:
            A ticket and a level; or tickets int64 [n] and levels [n], on the teacher's device.
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
            return_: undiscounted, of an episode on each level or a mean of several: a number, or
                numbers [n].
            success: whether, or of how many of them; from 0 to 1. It counts where all levels that
                are observed together have one.
            score: how much there is to learn on the level, where the loop says so itself, such as
                the mean of its absolute advantages; for curricula that score levels. For all
                levels of the teacher or for none.
            episodes: how many there were; None for one. One number may stand for all tickets.
            steps: how long they took together; likewise.

        Raises:
            ArgumentError: naming the argument: a ticket that is not out, a number that is missing
                or not finite, another shape.
        """
        given = (return_, success, score, episodes, steps)
        pairs = zip(RESULTS, given, strict=True)
        results = {n: one for n, one in pairs if one is not None or n == "return"}
        with self._here():
            self._require("rollout", False, "use observe(rollout)")
            self._require("success", success is not None, "tell it with success=")
            tickets = ids if type(ids) is int else as_ids("ids", ids)
            shape = () if type(ids) is int else (len(tickets),)
            self._tell(tickets, {name: as_result(name, results[name], shape) for name in results})

    def predicted(self, ids: Any) -> NDArray[np.float64] | None:
        """Returns the success that the curriculum expected of levels when it proposed them.

        Args:
            ids: tickets [n] that are out.

        Returns:
            [n]; None if it expects nothing.

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
        """Returns of which tickets [n] the results have been told, or that were dropped, [n]."""
        with self._here():
            return np.isin(self._ledger.states(as_ids("ids", ids)), (RETURNED, OVER))

    def drop(self, ids: Any = None) -> None:
        """Gives up levels of which no results will come, as of episodes that were cut off.

        Args:
            ids: the tickets, of which some may be over or have been told; None for all that are
                out, as where a resumed loop begins anew.
        """
        with self._here():
            if ids is None:
                dropped = self._ledger.out
                self._ledger.drop_all()
                self._whole.clear()
            else:
                tickets = as_ids("ids", ids)
                going = tickets[~self.done_with(tickets)]
                self._ledger.drop(self._ledger.find(going))
                dropped = len(going)
            self._tally.dropped(dropped)

    @torch.inference_mode(False)
    def observe(self, outcome: Any, ids: Any = None) -> None:
        """Takes the outcome of the levels that were proposed, or of those of some tickets.

        Args:
            outcome: by name, ``return`` and where there is such a thing ``success``, [n]; as
                :func:`~proposer_rl.curricula.outcome_of` makes it of a rollout [n, T] each row of
                which began with a reset on its level. Or a rollout [*B, T] with ``level_id``, as
                :class:`~proposer_rl.teaching.LevelTransform` puts it there: each episode that ends
                in it is one on the level that it began on, wherever that was.
            ids: the tickets; None for the levels of :meth:`propose`, if one batch is out.

        Raises:
            ArgumentError: see :meth:`tell`; if several batches are out, or a rollout does not say
                which levels it is of.
        """
        with self._here():
            if isinstance(outcome, TensorDictBase) and "next" in outcome.keys():
                kept = self._kept
                if kept is not None:  # of episodes that were not cut off since
                    states = self._ledger.states(as_ids("ids", kept[LEVEL_ID].reshape(-1)))
                    kept = kept[torch.from_numpy(states == OUT).to(kept[LEVEL_ID].device)]
                tickets, whole, left = ended(outcome, kept)
                if len(tickets):
                    self._observe_rollout(tickets, whole)
                self._kept = left
                return
            tickets = self._proposed() if ids is None else as_ids("ids", ids)
            results = by_name(outcome)
            if "rollout" in results:
                self._observe_rollout(tickets, results["rollout"])
            else:
                for name in ("rollout", "success"):
                    self._require(name, name in results, "put it into the outcome")
                shape = (len(tickets),)
                self._tell(
                    tickets, {name: as_result(name, results[name], shape) for name in results}
                )
            if ids is None:
                self._whole.clear()

    @torch.inference_mode(False)
    def log(self, file: str | os.PathLike[str] | None = None) -> dict[str, Any]:
        """Returns what happened since the last call, and the curriculum's own log.

        For every curriculum: how many levels were ``proposed``, ``told`` and ``dropped``, and are
        ``out`` now; ``mean_return`` and ``mean_success`` of the results, None without any;
        and ``drawn``, how many of the proposed levels there were in each bin of each parameter.
        The curriculum's own entries leave out results since the last proposal, so that logs change
        no curriculum.

        Args:
            file: JSON Lines to which it is added as a line, without levels, with the teacher's
                ``id`` as ``teacher``, and with ``levels_told`` since it began, for ``bin/report``,
                which draws each teacher by itself, and what goes on from an earlier state.

        Raises:
            StorageError: if the file cannot be written.
        """
        with self._here():
            self._count()
            record = {**self.curriculum.log(), **self._tally.read(self._ledger.out)}
            self._levels_told += record["told"]
            if file is not None:
                kept = {"teacher": self.id, "levels_told": self._levels_told, **record}
                kept.pop("levels", None)
                with storage(Path(file)), open(file, "a", encoding="utf-8") as lines:
                    lines.write(json.dumps(kept) + "\n")
            return record

    @torch.inference_mode(False)
    def state_dict(self) -> dict[str, Any]:
        """Returns all that a resumed loop needs, with the tickets that are out."""
        with self._here():
            kept = self._kept
            return {
                "of": self._of,
                "id": self.id,
                "levels_told": self._levels_told,
                "curriculum": self.curriculum.state_dict(),
                "ledger": self._ledger.state_dict(),
                "scored": self._scored,
                "proposals": self._proposals,
                "proposed": list(self._whole),
                "block": None if self._block is None else self._block.start,
                "at": self._at,
                "rollout": None if kept is None else packed(kept),
            }

    @torch.inference_mode(False)
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Puts back what :meth:`state_dict` returned, on whichever device its tensors are.

        Raises:
            ArgumentError: if it is of another space, curriculum or setting of it, naming what
                differs, or tickets are out, as of environments that have begun; then nothing has
                changed.
        """
        with self._here():
            state = tree_map_only(Tensor, Tensor.cpu, state)
            for what, now in self._of.items():
                require_same(what, state["of"][what], now)
            if self._ledger.out:
                raise ArgumentError(
                    "state: levels of this teacher are out, whose tickets it has for others; "
                    "load it before collectors and environments begin, or drop() them, and reset "
                    "what plays them"
                )
            self.id, self._levels_told = state["id"], state["levels_told"]
            self.curriculum.load_state_dict(state["curriculum"])
            self._ledger.load_state_dict(state["ledger"], self._like)
            self._scored = state["scored"]
            self._proposals, self._at = state["proposals"], state["at"]
            self._whole = list(state["proposed"])
            blocks = {block.start: block for block in self._ledger.blocks}
            self._block, self._tally = None, Tally(self.space)
            self._use(blocks.get(state["block"]), self._at)
            kept = state["rollout"]
            self._kept = None if kept is None else TensorDict.from_dict(dict(kept), batch_dims=1)

    def diverge(self, number: int) -> None:
        """Makes this teacher propose other levels, from the next one on, than its copies do.

        Each of several processes that made or loaded the same teacher calls it with a number of
        its own, such as its rank. With 0 nothing changes.
        """
        with self._here():
            if number:
                self._seed += number
                if self._block is not None:
                    self._block.state[self._at - self._block.start :] = OVER
                self._use(None, 0)

    @cached_property
    def _like(self) -> Levels:
        """One level of the space."""
        source: Any = self.space.space
        return source.sample(1, torch.Generator())[0]

    @cached_property
    def _of(self) -> dict[str, Any]:
        """The space and the curriculum that a state belongs to."""
        return {"space": of_levels(self.space, self._like), "curriculum": self._made_of}

    def client(self) -> TeacherClient:
        """Returns a client of this teacher for another process, such as a collector's worker.

        It has ``ask``, ``tell`` and ``drop``, and can be sent there.
        """
        with self._here():
            self._server = self._server or TeacherServer(self)
            return self._server.client()

    def __reduce__(self) -> Any:
        raise TypeError(
            "a teacher is not copied into another process, where it would be a second one; give "
            "that process teacher.client()"
        )

    def _here(self) -> RLock:
        if os.getpid() != self._process:
            raise RuntimeError(
                "this is a copy of a teacher that a forked process has; give that process "
                "teacher.client()"
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
        """Returns the block of the next of ``left`` tickets, a new one if the last is used up."""
        block = self._block
        if block is None or (left and self._at == block.end):
            # A loop that loses tickets must not have ever larger blocks.
            fitting = min(max(self._ledger.out + left, LEAST_BLOCK), LARGEST_BLOCK)
            block = self._next(max(self.block or fitting, left))
            self._use(block, block.start)
        return block

    def _use(self, block: Block | None, at: int) -> None:
        """Begins to hand out the tickets of a block, from ``at`` on."""
        self._count()
        self._block, self._at, self._counted = block, at, at
        self._rows, self._moved = [], None

    def _count(self) -> None:
        """Counts for the log what of the block was handed out."""
        block = self._block
        if block is not None and self._at > self._counted:
            some = slice(self._counted - block.start, self._at - block.start)
            self._tally.count(block.batch.levels[some])
            self._counted = self._at

    @torch.inference_mode(False)
    def _next(self, count: int) -> Block:
        """Lets the curriculum observe the results there are, and returns what it then proposes."""
        check_torch_defaults()
        for batch, results in self._ledger.take():
            self.curriculum.observe(self.student, batch, _outcome(results))
        rng = Streams(self._seed, "update", self._proposals)
        batch = proposed(self.curriculum, self.student, count, rng)
        self._proposals += 1
        return self._ledger.add(batch)

    def _levels(self, block: Block) -> Any:
        """Returns the levels of a block as the loop gets them, which may change them."""
        return self._given(moved(block.batch.levels, self.device).clone())

    def _tell(self, ids: int | NDArray[np.int64], results: Mapping[str, Any]) -> None:
        """Notes the results of a ticket or of tickets [n], and warns once where success lacks."""
        scored, known = "score" in results, "success" in results
        if self._scored not in (None, scored):
            how = "missing: other levels were told with one" if self._scored else "others had none"
            raise ArgumentError(f"score: {how}; give it for all or for none")
        if isinstance(ids, int):
            self._ledger.tell_one(ids, results)
        else:
            self._ledger.tell(self._ledger.find(ids), results)
        number = 1 if isinstance(ids, int) else len(ids)
        self._tally.returned(number, results["return"], results.get("success"))
        self._scored = scored
        if self._warned:
            return
        if not known and "success" in self.curriculum.optional_results:
            missing = "missing: this curriculum learns more from success than from returns; "
        elif self._with_success not in (None, known):
            missing = "told of some levels alone: curricula ignore it then; "
        else:
            self._with_success = known
            return
        self._warned = True
        warnings.warn(
            f"success: {missing}tell it of every level, also of failures, as with tell(..., "
            'success=), or success="terminated" of LevelTransform and TaughtEnv',
            stacklevel=3,
        )

    def _observe_rollout(self, ids: NDArray[np.int64], rollout: TensorDictBase) -> None:
        """Notes what came of a rollout [n, T] or [1, n, T], with a row for each ticket."""
        rollout = rollout[0] if rollout.ndim > 2 else rollout
        if len(rollout) != len(ids):
            raise ArgumentError(
                f"rollout: has shape {list(rollout.batch_size)}, but must have a row for each of "
                f"{len(ids)} levels"
            )
        outcome = outcome_of_rollout(rollout, self._success)
        known = "success" in outcome.keys()
        self._require("success", known, "give Teacher(success=...), or the rollout a next success")
        results: dict[str, NDArray[Any]] = {
            name: as_result(name, outcome[name], (len(ids),))
            for name in (("return", "success") if known else ("return",))
        }
        results["rollout"] = np.empty(len(ids), object)
        results["rollout"][:] = outcome["rollout"].unbind(0)
        self._tell(ids, results)

    def _require(self, name: str, known: bool, how: str) -> None:
        if name in self.required_results and not known:
            raise ArgumentError(f"{name}: missing: this curriculum reads it; {how}")

    def _proposed(self) -> NDArray[np.int64]:
        """Returns the tickets of the one batch that is out."""
        whole = [block for block in self._ledger.blocks if block.start in self._whole]
        out = [block for block in whole if (block.state == OUT).any()]
        if len(out) != 1:
            how = f"{len(out)} batches are out" if out else "nothing is out"
            raise ArgumentError(
                f"ids: missing: {how}; observe belongs to the last propose, and several at once "
                "need ask(n) and its tickets"
            )
        return np.arange(out[0].start, out[0].end)


def _outcome(results: Mapping[str, NDArray[Any]]) -> TensorDict:
    """Returns the outcome [m] that curricula observe, from results [m] by name."""
    numbers = dict(results)
    rollouts = numbers.pop("rollout").tolist()
    if any(rollout is None for rollout in rollouts):
        return as_outcome(numbers)
    outcome = outcome_of_episodes(rollouts)
    return outcome.exclude("success") if np.isnan(numbers["success"]).any() else outcome

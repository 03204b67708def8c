"""Levels that are out: who has which, and what has been told of them. A ticket is a number."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from proposer_rl.curricula import Batch
from proposer_rl.curricula.batches import of_kind, packed
from proposer_rl.settings import ArgumentError
from proposer_rl.task import Levels

Ids = NDArray[np.int64]

WAITS, OUT, TOLD, OVER = range(4)  # not handed out; handed out; told; observed or dropped
STATES = ("has not been handed out", "", "has been told before", "is over")
RESULTS = ("return", "success", "score", "episodes", "steps")
FIRST = 1024  # tickets that there is room for


@dataclass
class Block:
    """A batch of the curriculum's, and its first ticket."""

    start: int
    batch: Batch

    @cached_property
    def end(self) -> int:
        """The ticket after its last."""
        return self.start + self.batch.count


class Tickets:
    """Tickets in the order of their numbers; those of blocks that are over are forgotten.

    Args:
        students: K, for each of which there is a result.
    """

    def __init__(self, students: int) -> None:
        self.first = self.next = 0
        self.blocks: list[Block] = []
        self.state = np.zeros(FIRST, np.uint8)
        self.results = {name: np.full((students, FIRST), np.nan) for name in RESULTS}
        self.told = False  # whether anything has been since the last collection

    def add(self, batch: Batch) -> Block:
        """Number the levels of a batch."""
        block = Block(self.next, batch)
        self.blocks.append(block)
        self.next = block.end
        room = self.next - self.first - len(self.state)
        if room > 0:
            more = max(room, len(self.state))
            self.state = np.pad(self.state, (0, more))
            self.results = {
                name: np.pad(entry, ((0, 0), (0, more)), constant_values=np.nan)
                for name, entry in self.results.items()
            }
        return block

    def hand_out(self, start: int, end: int) -> None:
        """Note that tickets are out."""
        self.state[start - self.first : end - self.first] = OUT

    def places(self, ids: Ids) -> Ids:
        """Where tickets [n] stand that are out.

        Raises:
            ArgumentError: for one that is not out, or stands there twice.
        """
        place = ids - self.first
        inside = (ids >= self.first) & (ids < self.next)
        states = np.where(inside, self.state[place.clip(0, len(self.state) - 1)], OVER)
        wrong = np.flatnonzero(states != OUT)
        if len(wrong):
            ticket = int(ids[wrong[0]])
            known = 0 <= ticket < self.next
            reason = STATES[int(states[wrong[0]])] if known else "is no ticket of this teacher"
            raise ArgumentError(f"ids={ticket}: {reason}")
        if len(ids) > 1 and (np.diff(ids) <= 0).any():  # else they rise
            tickets, counts = np.unique(ids, return_counts=True)
            if (counts > 1).any():
                raise ArgumentError(f"ids={tickets[counts > 1][0]}: is there more than once")
        return place

    def tell(self, place: Ids, results: Mapping[str, NDArray[Any]]) -> None:
        """Note results [K, n] of tickets at places [n]."""
        for name, result in results.items():
            self.results[name][:, place] = result
        self.state[place] = TOLD
        self.told = True

    def tell_one(self, ticket: int, results: Iterable[tuple[str, float]]) -> None:
        """Note what came of one ticket of one student."""
        place = ticket - self.first
        if not (0 <= place < self.next - self.first and self.state[place] == OUT):
            self.places(np.array([ticket]))  # says what is wrong with it
        for name, number in results:
            self.results[name][0, place] = number
        self.state[place] = TOLD
        self.told = True

    def parts(self, ids: Ids) -> Iterator[tuple[Block, Ids]]:
        """The blocks of tickets [n], and where in ``ids`` those of each are."""
        starts = np.array([block.start for block in self.blocks])
        which = starts.searchsorted(ids, "right") - 1
        for number in np.unique(which).tolist():
            yield self.blocks[number], np.flatnonzero(which == number)

    def close(self, place: Ids) -> None:
        """Note that nothing more comes of tickets."""
        self.state[place] = OVER

    def collect(self, observe: Callable[[Batch, TensorDict], None]) -> None:
        """Give what has been told since the last time to a curriculum, and forget what is over."""
        for block in self.blocks if self.told else ():
            here = slice(block.start - self.first, block.end - self.first)
            which = np.flatnonzero(self.state[here] == TOLD)
            if not len(which):
                continue
            whole = len(which) == block.batch.count
            batch = block.batch if whole else block.batch[:, torch.from_numpy(which)]
            observe(batch, self._outcome(which + here.start))
            self.state[which + here.start] = OVER
        self.told = False
        self._forget()

    def _outcome(self, place: Ids) -> TensorDict:
        """What was told of tickets [n]: [K, n]."""
        outcome = {}
        for name, entry in self.results.items():
            result = entry[:, place]
            missing = np.isnan(result)
            if name in ("episodes", "steps"):
                outcome[name] = torch.from_numpy(np.where(missing, 1, result).astype(np.int64))
            elif not missing.any():
                outcome[name] = torch.from_numpy(result.astype(np.float32))
        return TensorDict(outcome, outcome["return"].shape)

    def _forget(self) -> None:
        """Forget the oldest blocks that are over."""
        while self.blocks:
            count = self.blocks[0].end - self.first
            if (self.state[:count] != OVER).any():
                return
            self.first = self.blocks.pop(0).end
            kept = self.next - self.first
            self.state[:kept] = self.state[count : count + kept].copy()
            self.state[kept:] = WAITS
            for entry in self.results.values():
                entry[:, :kept] = entry[:, count : count + kept].copy()
                entry[:, kept:] = np.nan

    def state_dict(self) -> dict[str, Any]:
        """All of it, with the levels that are out."""
        here = slice(0, self.next - self.first)
        return {
            "first": self.first,
            "next": self.next,
            "told": self.told,
            "state": torch.from_numpy(self.state[here].copy()),
            "results": {
                name: torch.from_numpy(entry[:, here].copy())
                for name, entry in self.results.items()
            },
            "blocks": [
                {
                    "start": block.start,
                    "count": block.batch.count,
                    "levels": packed(block.batch.levels),
                    "notes": packed(block.batch.notes),
                }
                for block in self.blocks
            ],
        }

    def load_state_dict(self, state: Mapping[str, Any], like: Levels, students: int) -> None:
        """Go on with it; ``like`` is a level of the kind."""
        Tickets.__init__(self, students)
        self.first = self.next = state["first"]
        for block in state["blocks"]:
            self.next = block["start"]  # what was between two of them is over
            shape = (students, block["count"])
            notes: Any = TensorDict.from_dict(dict(block["notes"]), batch_size=shape)
            self.add(Batch(of_kind(like, block["levels"], shape), notes.clone()))
        self.next = state["next"]
        count = self.next - self.first
        self.state[:count] = state["state"].numpy()
        for name, entry in state["results"].items():
            self.results[name][:, :count] = entry.numpy()
        self.told = state["told"]


def as_array(name: str, value: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Numbers of a shape as an array on the CPU, whatever they are given as.

    Raises:
        ArgumentError: naming the argument, if it has another shape or is not finite.
    """
    if isinstance(value, Tensor):
        value = value.detach().cpu()
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"{name}={value!r:.60}: must be numbers") from error
    if array.shape != shape:
        raise ArgumentError(
            f"{name}: has shape {list(array.shape)}, but must have {list(shape)}: one number for "
            "each level"
        )
    if not np.isfinite(array).all():
        raise ArgumentError(f"{name}={array[~np.isfinite(array)][0]}: must be finite")
    return array

"""Levels that are out: who has which, and what has been told of them. A ticket is a number."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any, NoReturn

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
COUNTS = ("episodes", "steps")


class Block:
    """A batch [K, n] of the curriculum's, its first ticket, and what has become of its levels.

    Attributes:
        end: the ticket after its last.
        state: of each ticket, uint8 [n].
        results: by name, [K, n]; NaN where nothing was told.
    """

    def __init__(self, start: int, batch: Batch) -> None:
        copies, count = batch.levels.shape[:2]
        self.start, self.end, self.batch = start, start + count, batch
        self.state = np.full(count, WAITS, np.uint8)
        self.results = {name: np.full((copies, count), np.nan) for name in RESULTS}


Parts = list[tuple[Block, Ids, Ids]]
"""Blocks that some tickets are of; which of them, and at which places of the block these are."""


class Tickets:
    """Tickets in the order of their numbers; those of blocks that are over are forgotten."""

    def __init__(self) -> None:
        self.next = 0
        self.blocks: list[Block] = []
        self.told = False  # whether anything has been since the last collection
        self.scored: bool | None = None  # whether with a score; None where nothing was told yet

    @property
    def out(self) -> bool:
        """Whether there are any that are out."""
        return any((block.state == OUT).any() for block in self.blocks)

    def add(self, batch: Batch) -> Block:
        """Number the levels of a batch."""
        block = Block(self.next, batch)
        self.blocks.append(block)
        self.next = block.end
        return block

    def states(self, ids: Ids) -> NDArray[np.uint8]:
        """What has become of tickets [n]; those that there never were wait."""
        states = np.where((ids >= 0) & (ids < self.next), OVER, WAITS).astype(np.uint8)
        for block in self.blocks:
            inside = (ids >= block.start) & (ids < block.end)
            states[inside] = block.state[ids[inside] - block.start]
        return states

    def find(self, ids: Ids) -> Parts:
        """Where tickets [n] are that are out.

        Raises:
            ArgumentError: for one that is not out, or stands there twice.
        """
        starts = np.array([block.start for block in self.blocks])
        number = starts.searchsorted(ids, "right") - 1
        parts = []
        for each in np.unique(number).tolist():
            which = np.flatnonzero(number == each)
            if each < 0:
                self._refuse(int(ids[which[0]]), OVER)
            block = self.blocks[each]
            place = ids[which] - block.start
            states = np.append(block.state, OVER).take(place, mode="clip")  # what is between blocks
            wrong = np.flatnonzero(states != OUT)
            if len(wrong):
                self._refuse(int(ids[which[wrong[0]]]), states[wrong[0]])
            parts.append((block, which, place))
        if len(ids) > 1 and (np.diff(ids) <= 0).any():  # else they rise
            tickets, counts = np.unique(ids, return_counts=True)
            if (counts > 1).any():
                raise ArgumentError(f"ids={tickets[counts > 1][0]}: is there more than once")
        return parts

    def tell(self, parts: Parts, results: Mapping[str, NDArray[Any]]) -> None:
        """Note results [K, n] of tickets [n] that were found.

        Raises:
            ArgumentError: if these have a score and others had none, or the other way round.
        """
        self._check_score("score" in results)
        for block, which, place in parts:
            for name, result in results.items():
                block.results[name][:, place] = result[:, which]
            block.state[place] = TOLD
        self.told = True

    def tell_one(self, ticket: int, results: Mapping[str, float]) -> None:
        """Note what came of one ticket of one student, as :meth:`find` and :meth:`tell` do."""
        number = bisect_right(self.blocks, ticket, key=attrgetter("start")) - 1
        place = ticket - self.blocks[number].start if number >= 0 else 0
        inside = number >= 0 and ticket < self.blocks[number].end
        if not (inside and self.blocks[number].state[place] == OUT):
            self.find(np.array([ticket]))  # says what is wrong with it
        self._check_score("score" in results)
        block = self.blocks[number]
        for name, result in results.items():
            block.results[name][0, place] = result
        block.state[place] = TOLD
        self.told = True

    def close(self, parts: Parts) -> None:
        """Note that nothing more comes of tickets that were found."""
        for block, _, place in parts:
            block.state[place] = OVER

    def close_all(self) -> None:
        """Note that nothing more comes of any that is out."""
        for block in self.blocks:
            block.state[block.state == OUT] = OVER

    def collect(self, observe: Callable[[Batch, TensorDict], None]) -> None:
        """Give what has been told since the last time to a curriculum, and forget what is over."""
        for block in self.blocks if self.told else ():
            place = np.flatnonzero(block.state == TOLD)
            if not len(place):
                continue
            whole = len(place) == block.batch.count
            batch = block.batch if whole else block.batch[:, torch.from_numpy(place)]
            observe(batch, _outcome(block, place))
            block.state[place] = OVER
        self.told = False
        self.blocks = [block for block in self.blocks if (block.state != OVER).any()]

    def _check_score(self, scored: bool) -> None:
        if self.scored not in (None, scored):
            how = "missing: other levels were told with one" if self.scored else "others had none"
            raise ArgumentError(f"score: {how}; give it for all or for none")
        self.scored = scored

    def _refuse(self, ticket: int, state: int) -> NoReturn:
        known = 0 <= ticket < self.next
        reason = STATES[state] if known else "is no ticket of this teacher"
        raise ArgumentError(f"ids={ticket}: {reason}")

    def state_dict(self) -> dict[str, Any]:
        """All of it, with the levels that are out."""
        return {
            "next": self.next,
            "told": self.told,
            "scored": self.scored,
            "blocks": [
                {
                    "start": block.start,
                    "levels": packed(block.batch.levels),
                    "notes": packed(block.batch.notes),
                    "state": torch.tensor(block.state),
                    "results": {name: torch.tensor(r) for name, r in block.results.items()},
                }
                for block in self.blocks
            ],
        }

    def load_state_dict(self, state: Mapping[str, Any], like: Levels) -> None:
        """Go on with it; ``like`` is a level of the kind."""
        self.blocks = []
        for kept in state["blocks"]:
            shape = kept["results"]["return"].shape
            notes: Any = TensorDict.from_dict(dict(kept["notes"]), batch_size=shape)
            batch = Batch(of_kind(like, kept["levels"]), notes.clone())
            block = Block(kept["start"], batch)
            block.state[:] = kept["state"].numpy()
            for name, result in kept["results"].items():
                block.results[name][:] = result.numpy()
            self.blocks.append(block)
        self.next, self.told, self.scored = state["next"], state["told"], state["scored"]


def _outcome(block: Block, place: Ids) -> TensorDict:
    """What was told of levels at places [n] of a block: [K, n]."""
    outcome = {}
    for name, entry in block.results.items():
        result = entry[:, place]
        missing = np.isnan(result)
        if name in COUNTS:
            outcome[name] = torch.from_numpy(np.where(missing, 1, result).astype(np.int64))
        elif not missing.any():
            outcome[name] = torch.from_numpy(result.astype(np.float32))
    return TensorDict(outcome, outcome["return"].shape)


def as_array(
    name: str, value: Any, shape: tuple[int, ...], for_all: bool = False
) -> NDArray[np.float64]:
    """Numbers of a shape as an array on the CPU, whatever they are given as.

    Args:
        name: of the argument.
        value: the numbers; of one level without that dimension, too.
        shape: [n] or [K, n].
        for_all: whether one number may stand for all.

    Raises:
        ArgumentError: naming the argument, if it has another shape or is not finite.
    """
    if isinstance(value, Tensor):
        value = value.detach().cpu().double()  # NumPy has no bfloat16
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, RuntimeError) as error:  # the last one of a gradient's tensors
        raise ArgumentError(f"{name}={value!r:.60}: must be numbers") from error
    if for_all and not array.ndim:
        array = np.full(shape, array)
    if shape[-1] == 1 and array.shape == shape[:-1]:
        array = array[..., np.newaxis]
    if array.shape != shape:
        raise ArgumentError(
            f"{name}: has shape {list(array.shape)}, but must have {list(shape)}: one number for "
            "each level"
        )
    if not np.isfinite(array).all():
        raise ArgumentError(f"{name}={array[~np.isfinite(array)][0]}: must be finite")
    return array

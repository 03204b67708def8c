"""Keeps track of proposed levels by id: waiting, handed out, returned, or over."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Mapping
from operator import attrgetter
from typing import Any, NamedTuple, NoReturn

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase

from proposer_rl.curricula.batches import packed, unpacked
from proposer_rl.curricula.contract import Batch
from proposer_rl.settings import ArgumentError
from proposer_rl.task import Levels

Ids = NDArray[np.int64]

WAITING, OUT, RETURNED, OVER = range(4)
"""Proposed; handed out; with a result that is not yet observed; observed or given up."""
STATES = ("has not been handed out", "", "has been told before", "is over")


class Block:
    """One proposal of a curriculum: levels [n] with consecutive ids.

    Attributes:
        start, end: the first id, and the one after the last.
        batch: the proposal; :meth:`Ledger.take` may cut it down to some of its levels.
        levels: all proposed levels, [n].
        state: of each level, uint8 [n].
        results: by name, [n]; NaN or None where there is none yet.
    """

    def __init__(self, start: int, batch: Batch, kinds: Mapping[str, type]) -> None:
        self.start, self.end = start, start + len(batch)
        self.batch, self.levels = batch, batch.levels
        self.state = np.full(len(batch), WAITING, np.uint8)
        self.results: dict[str, NDArray[Any]] = {
            name: np.full(len(batch), None if kind is object else np.nan, kind)
            for name, kind in kinds.items()
        }
        self.places: Ids | None = None  # of the levels to which the batch was cut down


class Found(NamedTuple):
    """Ids that :meth:`Ledger.find` found in one block.

    Attributes:
        block: that holds them.
        which: their positions among the ids that were asked for, int64 [m].
        place: their positions in the block, int64 [m].
    """

    block: Block
    which: Ids
    place: Ids


class Ledger:
    """Keeps the levels whose results a curriculum has yet to observe, in the order of proposal.

    Ids count levels from 0. Results may come back in any order, in parts or never; they are
    observed in the order of the ids.

    Args:
        kinds: types of the results of a level, by name: ``float`` or ``object``.

    Attributes:
        next: the id of the next level.
        blocks: blocks with levels that are not over.
        returned: whether there are results that :meth:`take` has not yielded yet.
    """

    def __init__(self, kinds: Mapping[str, type]) -> None:
        self.next, self.returned = 0, False
        self.blocks: list[Block] = []
        self._kinds = dict(kinds)

    @property
    def out(self) -> int:
        """The number of levels that are handed out."""
        return sum(int((block.state == OUT).sum()) for block in self.blocks)

    def add(self, batch: Batch) -> Block:
        """Gives ids to the levels of a batch; they wait until they are handed out."""
        block = Block(self.next, batch, self._kinds)
        self.blocks.append(block)
        self.next = block.end
        return block

    def block_of(self, id: int) -> Block | None:
        """Returns the block of an id; None if the id is unknown or its whole block is over."""
        number = bisect_right(self.blocks, id, key=attrgetter("start")) - 1
        block = self.blocks[number] if number >= 0 else None
        return block if block is not None and id < block.end else None

    def states(self, ids: Ids) -> NDArray[np.uint8]:
        """Returns the states of ids [n]; an unknown id counts as waiting."""
        states = np.where((ids >= 0) & (ids < self.next), OVER, WAITING).astype(np.uint8)
        for block, which, place in self._located(ids):
            states[which] = block.state[place]
        return states

    def find(self, ids: Ids) -> list[Found]:
        """Locates ids [n], all of which must be handed out.

        Raises:
            ArgumentError: for an id that is not handed out, or is given twice.
        """
        states = self.states(ids)
        for wrong in np.flatnonzero(states != OUT)[:1]:
            self._refuse(int(ids[wrong]), states[wrong])
        known, counts = np.unique(ids, return_counts=True)
        for twice in known[counts > 1][:1]:
            raise ArgumentError(f"ids={twice}: is there more than once")
        return self._located(ids)

    def _located(self, ids: Ids) -> list[Found]:
        """Locates those of ids [n] whose blocks are not over."""
        number = np.searchsorted([block.start for block in self.blocks], ids, "right") - 1
        parts = []
        for each in np.unique(number[number >= 0]).tolist():
            block = self.blocks[each]
            which = np.flatnonzero((number == each) & (ids < block.end))
            parts.append(Found(block, which, ids[which] - block.start))
        return parts

    def hand_out(self, id: int) -> Levels:
        """Hands out the waiting level, [], with this id."""
        block = self.block_of(id)
        assert block is not None  # which are kept until they are over
        block.state[id - block.start] = OUT
        return block.levels[id - block.start]

    def tell(self, parts: list[Found], results: Mapping[str, NDArray[Any]]) -> None:
        """Records results [n] for ids [n] that were found."""
        for block, which, place in parts:
            for name, result in results.items():
                block.results[name][place] = result[which]
            block.state[place] = RETURNED
        self.returned = True

    def tell_one(self, id: int, results: Mapping[str, Any]) -> None:
        """Records the results of one level.

        Raises:
            ArgumentError: if the level is not handed out.
        """
        block = self.block_of(id)
        place = 0 if block is None else id - block.start
        if block is None or block.state[place] != OUT:
            self.find(np.array([id]))  # raises the error
        assert block is not None
        for name, result in results.items():
            block.results[name][place] = result
        block.state[place] = RETURNED
        self.returned = True

    def drop(self, parts: list[Found]) -> None:
        """Gives up the ids that were found: no result is expected any more."""
        for block, _, place in parts:
            block.state[place] = OVER

    def is_out(self, id: int) -> bool:
        """Returns whether a level is handed out."""
        block = self.block_of(id)
        return block is not None and bool(block.state[id - block.start] == OUT)

    def drop_one(self, id: int) -> None:
        """Gives up one level, unless its result has come back."""
        block = self.block_of(id)
        if block is not None and block.state[id - block.start] <= OUT:
            block.state[id - block.start] = OVER

    def drop_all(self) -> None:
        """Gives up all levels that are handed out."""
        for block in self.blocks:
            block.state[block.state == OUT] = OVER

    def take(self, settled: bool = False) -> Iterator[tuple[Batch, dict[str, NDArray[Any]]]]:
        """Yields the results since the last call, block by block, and forgets the levels.

        Args:
            settled: whether to take a block only when none of its levels waits. Its batch is then
                cut down to the levels that were not given up, as if only these were proposed.

        Yields:
            A part of a batch [m], and its results [m] by name.
        """
        for block in self.blocks if self.returned or settled else ():
            state = block.state
            if settled and (state == WAITING).any():
                continue
            if settled and block.places is None:
                block.places = np.flatnonzero(state != OVER)
                some = block.batch[torch.from_numpy(block.places)]
                block.batch = Batch(some.levels, some.notes)
            ready = np.flatnonzero(state == RETURNED)
            if not len(ready):
                continue
            part = ready if block.places is None else block.places.searchsorted(ready)
            whole = len(part) == len(block.batch)
            batch = block.batch if whole else block.batch[torch.from_numpy(part)]
            yield batch, {name: result[ready] for name, result in block.results.items()}
            state[ready] = OVER
            for name, kind in self._kinds.items():
                if kind is object:
                    block.results[name][ready] = None
        self.returned = False
        self.blocks = [block for block in self.blocks if (block.state != OVER).any()]

    def _refuse(self, id: int, state: int) -> NoReturn:
        known = 0 <= id < self.next
        reason = STATES[state] if known else "is no ticket of this teacher"
        raise ArgumentError(f"ids={id}: {reason}")

    def state_dict(self) -> dict[str, Any]:
        """Returns the whole ledger, with the levels that are not over."""
        return {
            "next": self.next,
            "returned": self.returned,
            "blocks": [
                {
                    "start": block.start,
                    "levels": packed(block.levels),
                    "notes": packed(block.batch.notes),
                    "places": None if block.places is None else torch.tensor(block.places),
                    "state": torch.tensor(block.state),
                    "results": {name: _saved(result) for name, result in block.results.items()},
                }
                for block in self.blocks
            ],
        }

    def load_state_dict(
        self, state: Mapping[str, Any], like: Levels, device: torch.device | None = None
    ) -> None:
        """Restores what :meth:`state_dict` returned.

        Args:
            state: with tensors on the CPU.
            like: a level of the same kind, on the device for the levels.
            device: for results that are tensordicts.
        """
        self.blocks = []
        for kept in state["blocks"]:
            levels = unpacked(kept["levels"], like)
            places = kept["places"]
            some = levels if places is None else levels[places]
            notes: Any = TensorDict.from_dict(dict(kept["notes"]), batch_size=some.shape[:1])
            block = Block(kept["start"], Batch(levels), {})
            block.batch = Batch(some, notes.clone())
            block.places = None if places is None else places.numpy()
            block.state = kept["state"].numpy().copy()
            block.results = {
                name: _restored(result, block.state.shape, device)
                for name, result in kept["results"].items()
            }
            self.blocks.append(block)
        self.next, self.returned = state["next"], state["returned"]


def _saved(result: NDArray[Any]) -> Any:
    if result.dtype != object:
        return torch.tensor(result)
    return [[place, packed(entry)] for place, entry in enumerate(result) if entry is not None]


def _restored(saved: Any, shape: tuple[int, ...], device: torch.device | None) -> NDArray[Any]:
    if not isinstance(saved, list):
        restored: NDArray[Any] = saved.numpy().copy()
        return restored
    entries = np.full(shape, None, object)
    for place, entry in saved:
        episode: TensorDictBase = TensorDict.from_dict(entry, batch_dims=1)
        entries[place] = episode.to(device)
    return entries

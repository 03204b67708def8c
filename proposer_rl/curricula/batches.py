"""Copies, stores and compares batches of levels, whatever a task uses as a level."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase, is_tensor_collection
from torch import Tensor

from proposer_rl.settings import ArgumentError
from proposer_rl.task import Levels, Space

CPU = torch.device("cpu")
GOLDEN = np.uint64(0x9E3779B97F4A7C15)  # and what follows: SplitMix64's
MIX = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)


class SomeBins:
    """Draws levels uniformly from some of a space's bins.

    Args:
        space: that has the bins.
        values: allowed values of some of its axes, by name; errors call them ``new_levels``.

    Raises:
        ArgumentError: for an axis or a value that the space does not have.

    Example:
        >>> from proposer_rl.tasks.mazes.generation import SpecificationSpace
        >>> space = SpecificationSpace((0.0, 0.2), (2, 4, 6), height=6, width=6)
        >>> empty = SomeBins(space, {"obstacle fraction": [0.0]})
        >>> empty.bins
        tensor([0, 1, 2])
    """

    def __init__(self, space: Space, values: Mapping[str, list[float]]) -> None:
        axes = {name: list(known) for name, known in space.axes.items()}
        for name, wanted in values.items():
            if any(value not in axes.get(name, ()) for value in wanted):
                raise ArgumentError(
                    f"new_levels.{name}={wanted}: must be among the space's axes {axes}"
                )
        counts = [
            torch.tensor([value in values.get(name, known) for value in known])
            for name, known in axes.items()
        ]
        # The last axis runs fastest.
        grid = torch.cartesian_prod(*counts).reshape(-1, len(counts)).all(-1)
        self.bins = grid.nonzero().flatten()
        self._space = space

    def sample(self, count: int, generator: torch.Generator, /) -> Levels:
        """Draws levels [count]."""
        which = torch.randint(len(self.bins), (1, count), generator=generator)
        return levels_in(self._space, self.bins[which[0]], generator)


def levels_in(space: Space, bins: Tensor, generator: torch.Generator) -> Levels:
    """Returns one level [n] in each of the given bins, int64 [n]."""
    levels: Levels = space.generate(bins.unsqueeze(0), [generator])[0]
    return levels


def saved(value: Any) -> Any:
    """Returns a copy of an attribute for a state: its own ``state_dict``, or copies of its parts.

    Numbers, texts, tensors, tensordicts and levels are copied, also in lists and dicts.
    """
    if is_tensor_collection(value):
        return packed(value)
    if hasattr(value, "state_dict"):
        return value.state_dict()
    if isinstance(value, Mapping):
        return {key: saved(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [saved(entry) for entry in value]
    return value.clone() if isinstance(value, Tensor) else value


def restored(state: Any, present: Any) -> Any:
    """Returns the attribute that a state holds; the inverse of :func:`saved`.

    An object with a ``load_state_dict`` loads its part. Levels, also within a tensordict, get the
    class and the device of the present ones, which may be empty, ``levels[:0]``.
    """
    if is_tensor_collection(present):
        return unpacked(state, present)
    if not hasattr(present, "load_state_dict"):
        return saved(state)
    present.load_state_dict(state)
    return present


def packed(entries: TensorDictBase) -> dict[str, Any]:
    """Copies a tensordict into nested dicts, as checkpoints store them."""
    state: dict[str, Any] = entries.clone().to_dict(convert_tensors=False)
    return state


def unpacked(state: Mapping[str, Any], like: Any) -> Any:
    """Rebuilds the tensordict [m] that :func:`packed` copied.

    The tensordict, and levels in it, get the class and the device of ``like``.
    """
    if isinstance(like, TensorDict):
        entries = {
            name: unpacked(entry, like.get(name)) if isinstance(entry, Mapping) else entry.clone()
            for name, entry in state.items()
        }
        made: Any = TensorDict(entries).auto_batch_size_(1)
    else:
        made = type(like).from_dict(state, batch_dims=1).clone()
    return moved(made, device_of(like)) if len([*like.keys(True, True)]) else made


def finite(name: str, numbers: Tensor) -> Tensor:
    """Converts numbers to float64 on the CPU, and refuses NaN and infinity.

    Raises:
        ValueError: if they are not all finite.
    """
    numbers = numbers.double().cpu()
    if wrong := int((~numbers.isfinite()).sum()):
        raise ValueError(f"{name}: {wrong} of {numbers.numel()} numbers are not finite")
    return numbers


def device_of(levels: Levels) -> torch.device:
    """Returns the device of levels, which are a tensordict or a tensor."""
    if isinstance(levels, Tensor):
        return levels.device
    device: torch.device = next(iter(levels.values(True, True))).device
    return device


def moved(levels: Levels, device: torch.device) -> Levels:
    """Moves levels to a device, without a copy if they are there already."""
    return levels if device_of(levels) == device else levels.to(device)


def level_keys(levels: Any) -> Tensor:
    """Hashes each of levels [*B] to a number that only equal levels share: int64 [*B].

    It hashes the bytes of all entries, eight at a time, with the finalizer of SplitMix64 (Steele et
    al. 2014). Two different levels collide with a probability of about 2^-64.
    """
    count = levels.batch_size.numel()
    names = sorted(levels.keys(True, True), key=str)
    rows = [
        levels.get(name).cpu().reshape(count, -1).numpy().view(np.uint8).reshape(count, -1)
        for name in names
    ]
    width = sum(row.shape[1] for row in rows)
    padded = np.zeros((count, -(-width // 8) * 8), np.uint8)
    np.concatenate(rows, 1, out=padded[:, :width])
    key = np.full(count, width, np.uint64)
    for word in padded.view(np.uint64).T:
        key = (key ^ word) + GOLDEN
        key = (key ^ (key >> np.uint64(30))) * MIX[0]
        key = (key ^ (key >> np.uint64(27))) * MIX[1]
        key ^= key >> np.uint64(31)
    return torch.from_numpy(key.view(np.int64)).reshape(levels.batch_size)

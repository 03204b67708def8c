"""Numbers by which equal levels are known as such."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
MIX = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)


def level_keys(levels: Any) -> Tensor:
    """A number for each level, equal for equal levels and else different: int64 [*B].

    Hashes of the bytes of all entries, eight at a time: two levels collide with a probability of
    about 2^-64. Each eight go through the finalizer of SplitMix64 (Steele et al. 2014).
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

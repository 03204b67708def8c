"""Levels that are made of others by small edits: the children of ACCEL (arXiv 2203.01302)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor

from proposer_rl.curricula.scores import Scorer, episodes, unseen
from proposer_rl.curricula.student import Student
from proposer_rl.task import Levels

Edit = Callable[[Levels, int, Sequence[torch.Generator]], Levels]
"""Levels [K, n] after so many small random edits each, student k's from generator k."""
Parents = Literal["batch", "easy"]

EASY = 4  # parents of a batch of edits, where they are not all of the batch


def parents_among(evidence: TensorDictBase) -> Tensor:
    """Places of the parents of so many children as there are levels: int64 [K, n].

    All that was trained on; or where evidence [K, n] has the entry ``easy``, the few levels with
    most of it.
    """
    count = evidence.shape[1]
    if "easy" not in evidence.keys():
        return torch.arange(count).expand(evidence.shape)
    easiest = evidence["easy"].topk(min(EASY, count), -1).indices
    return easiest.repeat_interleave(-(-count // EASY), -1)[:, :count]


def easiness(student: Student, outcome: TensorDictBase) -> Tensor:
    """Mean absolute advantage minus mean return of levels [K, n]: what "easy" parents have most of.

    Of the published ones, those with the lowest return minus value loss (the authors' code, dcd).
    """
    if "rollout" not in outcome.keys():
        raise ValueError("parents=easy: the outcome has no rollout")
    rollout = outcome["rollout"]
    ended = episodes(rollout)
    loss = Scorer("l1_value_loss", "episodes")
    lost = loss.of_rollouts(student, [rollout], unseen(ended.ended.shape)).score
    return lost - (ended.total / ended.ended.clamp(1)).cpu()


def lineage(buffer: TensorDictBase, most: int) -> Tensor:
    """Slots of a buffer [n] that hold the longest line of levels, each edited from the one before.

    At most the last ``most`` of it.
    """
    place = {key: slot for slot, key in enumerate(buffer["key"].tolist())}
    parents = [place.get(key) for key in buffer["parent"].tolist()]
    longest: list[int] = []
    for slot in range(len(parents)):
        line, parent = [slot], parents[slot]
        while parent is not None and parent not in line and len(line) < most:
            line.append(parent)
            parent = parents[parent]
        longest = max(longest, line, key=len)
    return torch.tensor(longest[::-1])

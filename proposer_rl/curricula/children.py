"""Levels that are made of others by small edits: the children of ACCEL (arXiv 2203.01302)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor

from proposer_rl.curricula.batches import level_keys, levels_at
from proposer_rl.curricula.scores import Scorer, episodes, unseen
from proposer_rl.curricula.student import Student
from proposer_rl.settings import ArgumentError
from proposer_rl.task import Levels

Edit = Callable[[Levels, int, Sequence[torch.Generator]], Levels]
"""Levels [K, n] after so many small random edits each, student k's from generator k."""
Parents = Literal["batch", "easy"]

EASY = 4  # parents of a batch of edits, where they are not all of the batch


class Children:
    """Makes batches of children of what was trained on; false where there are none.

    Args:
        edit: of levels; None where they cannot be edited.
        edits: of each child; 0 for no children.
        parents: of a batch of children: all that was trained on (``batch``), or the four of it with
            the lowest difference of mean return and mean absolute advantage (``easy``).

    Attributes:
        reads: entries of an outcome by which parents are chosen.

    Raises:
        ArgumentError: if there are to be edits and nothing makes them.
    """

    def __init__(self, edit: Edit | None, edits: int, parents: Parents) -> None:
        if edits and edit is None:
            raise ArgumentError(
                f"edits={edits}: the task has no edit(levels, count, generators) of its levels; "
                "set edits=0"
            )
        self._edit, self._edits = edit, edits
        self.reads: tuple[str, ...] = ("rollout",) if edits and parents == "easy" else ()

    def __bool__(self) -> bool:
        return self._edits > 0

    def evidence(self, student: Student, outcome: TensorDictBase) -> dict[str, Tensor]:
        """What of an outcome [K, n] says which levels become parents, [K, n]."""
        return {"easy": _easiness(student, outcome)} if self.reads else {}

    def of(
        self, evidence: TensorDictBase, generation: Tensor, draws: Sequence[torch.Generator]
    ) -> tuple[Levels, dict[str, Tensor]]:
        """Children [K, n] of levels, and where they come from.

        Args:
            evidence: with ``level``, ``slot``, and what :meth:`evidence` gave, [K, n].
            generation: of the levels in the slots, int64 [K, N].
            draws: a generator for each student.

        Returns:
            The children; their ``parent`` and ``generation``, as a buffer has them.
        """
        assert self._edit is not None  # or there are no children
        count = evidence.shape[1]
        some = torch.arange(count).expand(evidence.shape)
        if self.reads:
            easiest = evidence["easy"].topk(min(EASY, count), -1).indices
            some = easiest.repeat_interleave(-(-count // EASY), -1)[:, :count]
        parents, slot = levels_at(evidence["level"], some), evidence["slot"].gather(1, some)
        origin = {"parent": level_keys(parents), "generation": generation.gather(1, slot) + 1}
        return self._edit(parents, self._edits, draws), origin


def _easiness(student: Student, outcome: TensorDictBase) -> Tensor:
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

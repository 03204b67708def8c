"""Small random edits of levels, from which a curriculum makes new levels of old ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import torch
from torch import Tensor

from proposer_rl.tasks.mazes.levels import Level, cell_index, cell_position

L = TypeVar("L", bound=Level)

FLIP_WALL, MOVE_GOAL, MOVE_START = range(3)


def edit_levels(levels: L, count: int, generators: Sequence[torch.Generator]) -> L:
    """Levels after a number of random edits, one after another.

    An edit is one of three operators, each with probability 1/3:

    - flip: a uniform cell that is neither start nor goal becomes an obstacle, or ceases to be one;
    - the goal moves to a uniform free cell other than start and goal;
    - the start does.

    Where there is no such cell, the level stays as it is. Nothing else is asked of an edit: the
    goal may become unreachable.

    It is the mutation of ACCEL (Parker-Holder et al. 2022, arXiv 2203.01302), with two deviations
    from how libraries draw it, among nothing, a flip and a move of the goal: no edit is wasted, and
    the start moves, too.

    Args:
        levels: valid levels ``[K, n]`` on any device; they are left as they are.
        count: edits of each level, at least 0. With the same generators the first ``count`` edits
            of more are those of fewer.
        generators: K generators of the CPU, one for each index of the first dimension: levels
            ``[k]`` depend on generator k alone.

    Returns:
        Valid levels ``[K, n]`` of the levels' class on their device; what else a level has, such as
        the direction of a :class:`~proposer_rl.tasks.view_mazes.levels.ViewLevel`, stays.

    Raises:
        ValueError: If ``count`` is negative, or the generators are not as many as the levels' first
            dimension.

    Example:
        >>> levels = Level.from_text(["S..G"] * 4).reshape(1, 4)
        >>> edit_levels(levels, 1, [torch.Generator().manual_seed(0)])[0].to_text()
        ['.S.G', 'S.#G', '.S.G', 'S.#G']
    """
    copies, number = levels.batch_size
    if count < 0:
        raise ValueError(f"count must be at least 0, got {count}")
    if len(generators) != copies:
        raise ValueError(
            f"{copies} generators are needed for levels of {copies} replicas, got {len(generators)}"
        )
    flat = levels.reshape(-1)  # [C]
    for _ in range(count):
        drawn = [
            (torch.randint(3, (number,), generator=draw), torch.rand(number, generator=draw))
            for draw in generators
        ]
        operator, place = (torch.cat(each) for each in zip(*drawn, strict=True))
        flat = _edit(flat, operator.to(levels.walls.device), place.to(levels.walls.device))
    return flat.reshape(copies, number).clone()


def _edit(levels: L, operator: Tensor, place: Tensor) -> L:
    """One edit of each of levels [C]: int64 [C] says which, float [C] in [0, 1) where."""
    width = levels.walls.shape[-1]
    walls = levels.walls.flatten(1)  # [C, H*W]
    start, goal = (cell_index(end, width).unsqueeze(1) for end in (levels.start, levels.goal))
    allowed = ~walls | (operator == FLIP_WALL).unsqueeze(1)
    allowed = allowed.scatter(1, start, False).scatter(1, goal, False)
    marked = allowed.cumsum(1, dtype=torch.int32)  # up to and with each cell
    choices = marked[:, -1]
    # Equal parts of [0, 1) lead to each cell; rounding may make the product their whole number.
    rank = (place * choices).int().minimum(choices - 1)
    cell = (marked <= rank.unsqueeze(1)).sum(1)  # [C]

    def applies(which: int) -> Tensor:
        return (operator == which) & (choices > 0)

    flipped = torch.zeros_like(walls).scatter(1, cell.unsqueeze(1), applies(FLIP_WALL).unsqueeze(1))
    position = cell_position(cell, width)  # [C, 2]
    edited: L = levels.replace(  # of the levels' own class: a direction stays
        walls=(walls ^ flipped).view_as(levels.walls),
        start=position.where(applies(MOVE_START).unsqueeze(1), levels.start),
        goal=position.where(applies(MOVE_GOAL).unsqueeze(1), levels.goal),
    )
    return edited

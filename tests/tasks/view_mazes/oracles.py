"""Random levels for the field's maze."""

from __future__ import annotations

from typing import Any

import torch

from proposer_rl.tasks.mazes.levels import cell_position
from proposer_rl.tasks.view_mazes.view_levels import ViewLevel


def random_levels(count: int, side: int = 13, seed: int = 0) -> ViewLevel:
    """Levels [count] of up to a third of walls; every second goal is a few cells from the start."""
    draw: Any = torch.Generator().manual_seed(seed)
    share = torch.rand(count, 1, generator=draw) / 3
    walls = torch.rand(count, side**2, generator=draw) < share
    ranks = torch.rand(count, side**2, generator=draw).argsort(1)
    start, goal = ranks[:, 0], ranks[:, 1]
    near = torch.randint(1, 3, (count,), generator=draw)
    beside = torch.where(start % side + near < side, start + near, start - near)
    goal = torch.where(torch.arange(count) % 2 == 0, goal, beside)
    for cell in (start, goal):
        walls[torch.arange(count), cell] = False
    return ViewLevel(
        walls=walls.view(count, side, side),
        start=cell_position(start, side),
        goal=cell_position(goal, side),
        direction=torch.randint(4, (count,), generator=draw),
        batch_size=[count],
    )

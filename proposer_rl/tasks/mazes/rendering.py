"""Mazes for readers: pictures as arrays of colours, and records of what a Solver did."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from proposer_rl.learning import in_first_episode
from proposer_rl.runs.records import png
from proposer_rl.tasks.mazes.levels import FREE, Level

EPISODE = "•"  # a free cell that the Solver's episode went through

# Okabe and Ito's palette, which stays distinct under the common forms of colour blindness.
WALL_COLOUR = (45, 45, 45)
FREE_COLOUR = (250, 250, 250)
LINE_COLOUR = (215, 215, 215)
START_COLOUR = (0, 114, 178)  # blue
GOAL_COLOUR = (230, 159, 0)  # orange
PATH_COLOUR = (204, 121, 167)  # reddish purple
AGENT_COLOUR = (0, 158, 115)  # bluish green
DIRECTION_COLOUR = (255, 255, 255)

Cells = Sequence[Sequence[int]] | Tensor


def draw_level(
    level: Level, path: Cells | None = None, agent: Sequence[int] | None = None, cell: int = 16
) -> Tensor:
    """Draws one level.

    Args:
        level: A level of batch shape ``[]``; if it has a ``direction`` (0 right, 1 down, 2 left,
            3 up), a white triangle in the start's cell points there.
        path: Cells (row, column) to connect by a line, ``[T, 2]``; successive cells are equal or
            share a side.
        agent: Row and column at which to draw a round agent.
        cell: Side of a cell in pixels, at least 4.

    Returns:
        uint8 ``[H * cell + 1, W * cell + 1, 3]`` on the CPU, with lines one pixel wide between
        cells.
    """
    walls = level.walls.cpu()
    height, width = walls.shape
    colours = torch.tensor([FREE_COLOUR, WALL_COLOUR], dtype=torch.uint8)[walls.long()]
    colours[tuple(level.start.tolist())] = torch.tensor(START_COLOUR, dtype=torch.uint8)
    colours[tuple(level.goal.tolist())] = torch.tensor(GOAL_COLOUR, dtype=torch.uint8)
    picture = torch.empty(height * cell + 1, width * cell + 1, 3, dtype=torch.uint8)
    picture[:-1, :-1] = colours.repeat_interleave(cell, 0).repeat_interleave(cell, 1)
    picture[::cell] = picture[:, ::cell] = torch.tensor(LINE_COLOUR, dtype=torch.uint8)
    if path is not None:
        centre = torch.as_tensor(path).cpu() * cell + cell // 2  # [T, 2]
        half = max(cell // 10, 1)
        for here, there in zip(centre, torch.cat([centre[1:], centre[-1:]]), strict=True):
            top, left = (torch.minimum(here, there) - half).tolist()
            bottom, right = (torch.maximum(here, there) + half + 1).tolist()
            picture[top:bottom, left:right] = torch.tensor(PATH_COLOUR, dtype=torch.uint8)
    offset = torch.arange(cell) - cell // 2
    if hasattr(level, "direction"):
        tip = (0.35 * cell - offset) / 2  # half of the triangle's height, by column
        to_the_right = (offset.abs().unsqueeze(1) <= tip) & (offset >= -0.25 * cell)
        triangle = to_the_right.rot90(-int(level.direction))
        _paint(picture, level.start.tolist(), triangle, DIRECTION_COLOUR)
    if agent is not None:
        round_one = offset.square().unsqueeze(1) + offset.square() <= (0.3 * cell) ** 2
        _paint(picture, agent, round_one, AGENT_COLOUR)
    return picture


def level_records(levels: Level, rollout: TensorDictBase | None) -> Iterator[dict[str, Any]]:
    """Draws levels [n], with the Solver's first episode there [n, T], as records."""
    levels = levels.cpu()
    for i, text in enumerate(levels.to_text()):
        path = None if rollout is None else _first_path(rollout[i])
        lines = [list(line) for line in text.splitlines()]
        for row, column in path or []:
            if lines[row][column] == FREE:
                lines[row][column] = EPISODE
        yield {
            "picture": png(draw_level(levels[i], path).numpy()),
            "text": [" ".join(line) for line in lines],
            **({} if path is None else {"path": path}),
        }


def recorded_drawing(record: Mapping[str, Any]) -> list[str]:
    """Returns the rows of a level from its record, without the Solver's path."""
    return [line.replace(" ", "").replace(EPISODE, FREE) for line in record["text"]]


def _first_path(steps: TensorDictBase) -> list[list[int]]:
    """Cells (row, column) that the agent was in, from the start to the end of its episode [T]."""
    first = in_first_episode(steps)
    return steps["agent"][:1].tolist() + steps["next", "agent"][first].tolist()


def _paint(
    picture: Tensor, place: Sequence[int], shape: Tensor, colour: tuple[int, int, int]
) -> None:
    """Paints what a bool ``[cell, cell]`` covers of the cell at a row and column."""
    cell = len(shape)
    top, left = (int(number) * cell for number in place)
    square = picture[top : top + cell, left : left + cell]
    square[shape] = torch.tensor(colour, dtype=torch.uint8)

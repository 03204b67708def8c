"""What a reader is told of mazes, whatever an agent can do there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.learning import first_episode_success
from proposer_rl.runs.pictures import png
from proposer_rl.tasks.mazes.levels import FREE, Level
from proposer_rl.tasks.mazes.rendering import draw_level

EPISODE = "•"  # a free cell that the Solver's episode went through


def level_statistics(
    levels: Level, rollout: TensorDictBase, length: Tensor, solvable: Tensor
) -> TensorDict:
    """What Solvers trained on and how they fared there, each [K] from [K, P].

    - ``obstacle_fraction``: obstacles per cell;
    - ``path_length``, ``path_length_sd``: mean and standard deviation of the moves on the shortest
      path, over the levels that have a path; both 0 where none has;
    - ``solvable``: share of the levels whose goal can be reached within the step limit;
    - ``train_success``: share of the levels whose goal the first episode reached.

    Args:
        levels: Levels ``[K, P]``.
        rollout: of Solvers on them, ``[K, P, T]``.
        length: Moves on the shortest paths, int64 ``[K, P]``; negative where there is none.
        solvable: bool ``[K, P]``.
    """
    mean, deviation = _moments(length.float(), length >= 0)
    return TensorDict(
        {
            "obstacle_fraction": levels.walls.float().mean((-3, -2, -1)),
            "path_length": mean,
            "path_length_sd": deviation,
            "solvable": solvable.float().mean(-1),
            "train_success": first_episode_success(rollout).float().mean(-1),
        },
        levels.batch_size[:1],
    )


def level_records(levels: Level, rollout: TensorDictBase | None) -> Iterator[dict[str, Any]]:
    """Drawings of levels [n], with the Solver's first episode there [n, T] and its cells."""
    levels = levels.cpu()
    for i, text in enumerate(levels.to_text()):
        path = None if rollout is None else first_path(rollout[i])
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
    """The rows of a level from its record, without what the Solver did there."""
    return [line.replace(" ", "").replace(EPISODE, FREE) for line in record["text"]]


def first_path(steps: TensorDictBase) -> list[list[int]]:
    """Cells (row, column) that the agent was in, from the start to the end of its episode [T]."""
    ended = steps["next", "done"].squeeze(-1).tolist()
    count = ended.index(True) + 1 if True in ended else len(ended)
    return steps["agent"][:1].tolist() + steps["next", "agent"][:count].tolist()


def _moments(values: Tensor, which: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of some of the values [*B, P], 0 of none: float [*B] each."""
    count = which.sum(-1).clamp_min(1)
    mean = (values * which).sum(-1) / count
    square = (values - mean.unsqueeze(-1)).square()
    return mean, ((square * which).sum(-1) / count).sqrt()

"""What a task cannot give, or must not be asked: one line, and nothing is written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.tasks.gymnasium.toys import TINY

CARS = ["task=cartpole", *TINY]
VIEWS = ["task=view_maze_smoke", "compute.progress=false"]


@pytest.mark.usefixtures("own_folder")
@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([*CARS, "+method=regret"], "GymnasiumTask must define optimal_return(levels)"),
        ([*CARS, "+method=pace"], "must define differentiable_performance(agent, levels)"),
        (
            [*CARS, "+method=plr", "compute.collector=multiprocess"],
            "leave compute.collector=single; task.vectorization=async spreads one Solver's env",
        ),
        ([*CARS, "+method=first_order_proposer"], "needs a student with target_direction"),
        (
            [*VIEWS, "+method=first_order_gain"],
            "ViewMazeTask must define differentiable_performance",
        ),
        ([*VIEWS, "+method=regret"], "needs a student with exact_performance: ViewMazeTask"),
        ([*VIEWS, "+method=sfl"], "needs a student with exact_performance: ViewMazeTask"),
        ([*VIEWS, "+method=target", "task.maze.height=4"], "ood: perfect mazes have odd"),
        ([*VIEWS, "+method=target", "task.space.walls=[24]"], "space: 5x5 cells have at most 23"),
        (
            [*VIEWS, "+method=target", "task.distributions.id.kind=spiral"],
            "input tag 'spiral' found using 'kind' does not match any of the expected tags",
        ),
    ],
)
def test_what_a_task_lacks_is_refused_before_anything_is_written(
    words: list[str], said: str, train: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(*words, "hydra.run.dir=run") == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and said in lines[0]
    assert not Path("run").exists()

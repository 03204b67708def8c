"""A sheet of levels with the paths that a Solver takes there."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence

from matplotlib import rc_context
from matplotlib.figure import Figure

from proposer_rl.mazes import Level, draw_level
from proposer_rl.mazes.level_scores import Score
from proposer_rl.report.style import SETTINGS

COLUMNS = 6
SIDE = 1.9  # inches of a level
KEY = "Blue: start. Orange: goal. Purple: the path of the most probable actions."


def draw_paths(levels: Mapping[str, Level], scores: Sequence[Score], title: str) -> bytes:
    """Draws levels side by side, each with its score and the Solver's greedy path.

    Args:
        levels: Levels of batch shape ``[]`` by their names.
        scores: One for each level to draw.
        title: Above the sheet.

    Returns:
        A PNG file.
    """
    columns = min(COLUMNS, len(scores))
    rows = -(-len(scores) // columns)
    with rc_context(SETTINGS):
        figure = Figure(
            figsize=(max(SIDE * columns, 5), (SIDE + 0.45) * rows + 0.7), layout="constrained"
        )
        # Names come from files: a dollar sign in one is no formula.
        figure.suptitle(f"{title}\n{KEY}", fontsize=9, parse_math=False)
        grid = figure.subplots(rows, columns, squeeze=False)
        for axes in grid.flat:
            axes.set_axis_off()
        for axes, score in zip(grid.flat, scores, strict=False):
            axes.imshow(draw_level(levels[score.level], score.path).numpy())
            axes.set_title(_caption(score), fontsize=7, parse_math=False)
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=110)
    return file.getvalue()


def _caption(score: Score) -> str:
    greedy = f"greedy {len(score.path) - 1}" if score.greedy_success else "greedy fails"
    return f"{score.level}: {score.success:.0%}\nshortest {score.path_length}, {greedy}"

"""Solvers on named levels, against hand-made policies, episodes that are played, and each other."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from matplotlib.image import imread
from torch import Tensor, nn

from proposer_rl.mazes import Level, planes
from proposer_rl.mazes.evaluation import RolloutEvaluator
from proposer_rl.mazes.level_files import levels_from_text, shipped_levels
from proposer_rl.mazes.level_pictures import draw_paths
from proposer_rl.mazes.level_scores import Score, score_levels
from proposer_rl.models import Population, UNet, cell_logits, map_actor_critic
from tests.mazes.oracles import random_levels

UP, DOWN, LEFT, RIGHT = range(4)

HALLS = """
[right]
S...G
[down]
S
.
G
[right too]
..S.G
.....
[blocked]
S#.
..G
"""


class Always(nn.Module):
    """A network that would always go one way."""

    def __init__(self, action: int, channels: int = 3) -> None:
        super().__init__()
        logits = torch.zeros(4)
        logits[action] = 200.0  # the probability of all others is rounded to nothing
        self.logits = nn.Parameter(logits)
        self.channels = channels

    def forward(self, planes: Tensor) -> tuple[Tensor, Tensor]:
        assert planes.shape[-3] == self.channels
        maps = self.logits[:, None, None].expand(*planes.shape[:-3], 4, *planes.shape[-2:])
        return maps, maps[..., :1, :, :]


def test_policies_whose_scores_are_known() -> None:
    actions = iter([RIGHT, DOWN])
    solver = map_actor_critic(Population(lambda: Always(next(actions)), 2))
    scores = score_levels(solver, levels_from_text(HALLS), lambda length: 2 * length, 0.125)
    assert [(s.level, s.solver) for s in scores] == [
        (name, k) for name in ("right", "down", "right too", "blocked") for k in (0, 1)
    ]
    assert [(s.height, s.width) for s in scores[::2]] == [(1, 5), (3, 1), (2, 5), (2, 3)]
    assert [s.path_length for s in scores[::2]] == [4, 2, 2, 3]
    assert all(s.max_steps == 2 * s.path_length for s in scores)
    solved = {("right", 0): 4, ("down", 1): 2, ("right too", 0): 2}
    for s in scores:
        moves = solved.get((s.level, s.solver))
        success = float(moves is not None)
        expected = success - 0.125 * (moves or s.max_steps)
        assert s.success == s.greedy_success == success
        assert s.mean_return == pytest.approx(expected)
        assert s.greedy_return == pytest.approx(expected)
        assert len(s.path) == 1 + (moves or s.max_steps)
    assert scores[0].path == [[0, 0], [0, 1], [0, 2], [0, 3], [0, 4]]
    assert scores[7].path == [[0, 0], *[[1, 0]] * 6]


def solvers(per_step: bool = False) -> object:
    torch.manual_seed(0)
    network = Population(
        lambda: UNet(3 + per_step, channels=(8, 8, 8), groups=4, head_gains=(3.0, 1.0)), 2
    )
    return map_actor_critic(network, per_step=per_step)


def test_a_level_has_the_same_score_in_any_company() -> None:
    """Sizes in turn, odd ones too: grouping them must not mix them up."""
    solver = solvers()
    sizes = [(5, 4), (7, 7), (5, 4), (9, 6), (7, 7), (4, 5)]
    levels = {str(i): random_levels(1, *size, 0.1, i)[0] for i, size in enumerate(sizes)}
    together = score_levels(solver, levels, lambda length: 12)
    alone = [s for n, v in levels.items() for s in score_levels(solver, {n: v}, lambda length: 12)]
    for one, other in zip(together, alone, strict=True):
        assert (one.level, one.solver, one.path) == (other.level, other.solver, other.path)
        assert one.success == pytest.approx(other.success, abs=1e-5)
        assert one.mean_return == pytest.approx(other.mean_return, abs=1e-5)
    assert len({round(s.success, 6) for s in together}) > 6


def test_many_levels_go_through_the_network_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    levels = {str(i): level for i, level in enumerate(random_levels(7, 4, 4, 0.1, 0))}
    whole = score_levels(solvers(), levels, lambda length: 9)
    monkeypatch.setattr("proposer_rl.mazes.level_scores.AT_ONCE", 2 * 16)
    parts = score_levels(solvers(), levels, lambda length: 9)
    assert [s.path for s in parts] == [s.path for s in whole]
    assert [s.success for s in parts] == pytest.approx([s.success for s in whole], abs=1e-5)


@pytest.mark.parametrize("per_step", [False, True])
def test_scores_are_what_playing_gives(per_step: bool) -> None:
    solver = solvers(per_step)
    level = random_levels(1, 5, 7, 0.1, 4)[0]
    scores = score_levels(solver, {"level": level}, lambda length: 20, 0.05)
    copies = level.expand(2, 1)
    player = RolloutEvaluator(20, 0.05, episodes=4000, generator=torch.Generator().manual_seed(0))
    played = player(copies, cell_logits(solver, planes(copies)))
    for k, score in enumerate(scores):
        assert score.success == pytest.approx(float(played["success"][k, 0]), abs=0.03)
        assert score.mean_return == pytest.approx(float(played["return"][k, 0]), abs=0.05)


def test_every_shape_goes_through_the_network() -> None:
    levels = shipped_levels("shapes")
    scores = score_levels(solvers(), levels, lambda length: 2 * length)
    assert len(scores) == 2 * len(levels)
    assert all(0 <= s.success <= 1 and s.greedy_success in (0, 1) for s in scores)


def test_pictures(tmp_path: Path) -> None:
    levels = {"a $x^{$": Level.from_text("S..\n..G"), "b": Level.from_text("S.\n#.\n#G")}
    scores = [
        Score("a $x^{$", 0, 2, 3, 3, 6, 0.5, 0.4, 1.0, 0.97, [[0, 0], [0, 1], [1, 1], [1, 2]]),
        Score("b", 0, 3, 2, 3, 6, 0.0, -0.1, 0.0, -0.06, [[0, 0]] * 7),
    ]
    file = tmp_path / "sheet.png"
    file.write_bytes(draw_paths(levels, scores, "title [b]"))
    picture = imread(file)[..., :3]
    purple = (picture - torch.tensor([204, 121, 167]).numpy() / 255).__abs__().max(-1) < 0.02
    assert purple[:, : purple.shape[1] // 2].sum() > 3 * purple[:, purple.shape[1] // 2 :].sum() > 0

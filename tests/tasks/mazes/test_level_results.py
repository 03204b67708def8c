"""Solvers on named levels, against hand-made policies, episodes that are played, and each other."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import pytest
import torch
from torch import Tensor, nn

from proposer_rl.models import ActorCritic, Population, UNet, cell_logits, map_actor_critic
from proposer_rl.task import LevelResult
from proposer_rl.tasks.mazes import Level, planes
from proposer_rl.tasks.mazes.drawings import levels_from_text
from proposer_rl.tasks.mazes.evaluation import RolloutEvaluator
from proposer_rl.tasks.mazes.task import MazeSettings
from tests.tasks.mazes.oracles import random_levels
from tests.tiny import tiny_task

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


def results(
    agent: ActorCritic,
    levels: Mapping[str, Level],
    limit_of: Callable[[int], int],
    step_penalty: float = 0.01,
) -> list[LevelResult]:
    rules = MazeSettings(height=5, width=5, max_steps=8, step_penalty=step_penalty)
    return tiny_task(maze=rules).results_of(agent, levels, limit_of)


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
    scores = results(solver, levels_from_text(HALLS), lambda length: 2 * length, 0.125)
    assert [(s.level, s.solver) for s in scores] == [
        (name, k) for name in ("right", "down", "right too", "blocked") for k in (0, 1)
    ]
    sizes = [(1, 5, 4), (3, 1, 2), (2, 5, 2), (2, 3, 3)]
    about = ("height", "width", "path_length")
    assert [tuple(s.about[key] for key in about) for s in scores[::2]] == sizes
    solved = {("right", 0): 4, ("down", 1): 2, ("right too", 0): 2}
    for s in scores:
        moves, length = solved.get((s.level, s.solver)), s.about["path_length"]
        assert s.about["max_steps"] == 2 * length
        success = float(moves is not None)
        expected = success - 0.125 * (moves or 2 * length)
        assert s.results == {
            "success": success,
            "greedy_success": success,
            "return": pytest.approx(expected),
            "greedy_return": pytest.approx(expected),
        }


def solvers(per_step: bool = False) -> ActorCritic:
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
    together = results(solver, levels, lambda length: 12)
    alone = [s for n, v in levels.items() for s in results(solver, {n: v}, lambda length: 12)]
    for one, other in zip(together, alone, strict=True):
        assert one[:3] == other[:3]
        assert one.results == pytest.approx(other.results, abs=1e-5)
    assert len({round(s.results["success"], 6) for s in together}) > 6


def test_many_levels_go_through_the_network_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    levels = {str(i): level for i, level in enumerate(random_levels(7, 4, 4, 0.1, 0))}
    whole = results(solvers(), levels, lambda length: 9)
    monkeypatch.setattr("proposer_rl.tasks.mazes.task.CELLS_AT_ONCE", 2 * 16)
    parts = results(solvers(), levels, lambda length: 9)
    for one, other in zip(parts, whole, strict=True):
        assert one[:3] == other[:3]
        assert one.results == pytest.approx(other.results, abs=1e-5)


@pytest.mark.parametrize("per_step", [False, True])
def test_scores_are_what_playing_gives(per_step: bool) -> None:
    solver = solvers(per_step)
    level = random_levels(1, 5, 7, 0.1, 4)[0]
    scores = results(solver, {"level": level}, lambda length: 20, 0.05)
    copies = level.expand(2, 1)
    player, draws = RolloutEvaluator(20, 0.05, episodes=4000), torch.Generator().manual_seed(0)
    played = player(copies, cell_logits(solver, planes(copies)), draws)
    for k, score in enumerate(scores):
        for key, tolerance in (("success", 0.03), ("return", 0.05)):
            assert score.results[key] == pytest.approx(float(played[key][k, 0]), abs=tolerance)

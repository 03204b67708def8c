"""How Solvers with memory do on named levels, one by one: they play on each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import binomtest
from tensordict import TensorDictBase

from proposer_rl.learning import RolloutPolicy
from proposer_rl.models import ActorCritic
from proposer_rl.streams import Streams
from proposer_rl.task import Score
from proposer_rl.tasks.mazes.level_scores import alike, in_order_of
from proposer_rl.tasks.mazes.records import first_path
from proposer_rl.tasks.mazes.rendering import draw_level
from proposer_rl.tasks.view_mazes.distance import fewest_actions
from proposer_rl.tasks.view_mazes.env import ViewMazeEnv
from proposer_rl.tasks.view_mazes.evaluation import play
from proposer_rl.tasks.view_mazes.levels import ViewLevel

AT_ONCE = 4096  # episodes that are played together


def score_view_levels(
    agent: ActorCritic,
    levels: Mapping[str, ViewLevel],
    max_steps: Callable[[int], int],
    episodes: int,
    streams: Streams,
    device: torch.device,
) -> list[Score]:
    """Plays episodes on levels of any size.

    Args:
        agent: K Solvers.
        levels: Levels of batch shape ``[]`` by their names.
        max_steps: The step limit of a level, given the fewest actions to its goal.
        episodes: On each level.
        streams: That actions are drawn from.
        device: That of the Solvers.

    Returns:
        One score for each level and Solver, in the levels' order. ``about``: ``height``, ``width``,
        ``fewest_actions`` (turns included) and ``max_steps``. ``results``: ``success``, the share
        of episodes that reached the goal, with the bounds of its 95 % interval (Wilson 1927),
        ``success_low`` and ``success_high``, and ``return``, the mean.
    """
    fewest = {name: int(fewest_actions(level)) for name, level in levels.items()}
    limits = {name: max_steps(actions) for name, actions in fewest.items()}
    scores: list[Score] = []
    for names, limit in alike(levels, limits, lambda _: AT_ONCE // episodes):
        batch: Any = torch.stack([levels[name] for name in names]).to(device)
        generator = streams.generator(names[0])
        found = play(agent, batch, limit, episodes, generator).cpu()
        height, width = batch.walls.shape[-2:]
        about = {"height": height, "width": width, "max_steps": limit}
        for i, name in enumerate(names):
            told = {**about, "fewest_actions": fewest[name]}
            draw = partial(_picture, agent, level=batch[i], limit=limit, streams=streams)
            scores += _scored(found[:, i], name, told, episodes, draw)
    return in_order_of(levels, scores)


def _scored(
    found: TensorDictBase,
    name: str,
    about: Mapping[str, float],
    episodes: int,
    draw: Callable[[int], NDArray[np.uint8]],
) -> Iterator[Score]:
    """Scores of K Solvers on one level, given what was found there, [K]."""
    for k, (success, mean) in enumerate(zip(found["success"], found["return"], strict=True)):
        reached = round(float(success) * episodes)
        interval = binomtest(reached, episodes).proportion_ci(method="wilson")
        results = {
            "success": reached / episodes,
            "success_low": float(interval.low),
            "success_high": float(interval.high),
            "return": float(mean),
        }
        note = f"{reached} of {episodes} episodes, fewest actions {about['fewest_actions']}"
        yield Score(name, k, about, results, note, partial(draw, k))


@torch.no_grad()
def _picture(
    agent: ActorCritic, solver: int, *, level: ViewLevel, limit: int, streams: Streams
) -> NDArray[np.uint8]:
    """A level, and one episode of one Solver there."""
    env = ViewMazeEnv(level.expand(agent.copies, 1), max_steps=limit)
    policy = RolloutPolicy(agent)
    generator = streams.generator("picture")
    noise = torch.rand(limit, 1, 1, generator=generator).to(level.walls.device)
    policy.begin(noise.expand(limit, *env.batch_size))
    rollout = env.rollout(limit, policy, break_when_any_done=False)
    return draw_level(level, first_path(rollout[solver, 0])).numpy()

"""Where Solvers with memory go on fixed levels: they play there."""

from __future__ import annotations

import torch
from torch import Tensor

from proposer_rl.learning import play_episodes
from proposer_rl.models import ActorCritic
from proposer_rl.tasks.mazes.levels import cell_plane
from proposer_rl.tasks.view_mazes.env import ViewMazeEnv
from proposer_rl.tasks.view_mazes.levels import ViewLevel


@torch.no_grad()
def walks(
    agent: ActorCritic, levels: ViewLevel, max_steps: int, noise: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Where K Solvers go on levels, one episode on each.

    Args:
        agent: K Solvers.
        levels: Levels ``[N]``.
        max_steps: Step limit T of an episode.
        noise: Of the actions, float ``[T, N]``, 0 to 1; None for the most probable ones.

    Returns:
        Row, column and direction before every step and at the end, int64 ``[K, N, T + 1, 3]``, and
        the number of steps, int64 ``[K, N]``; what comes after them has no meaning.
    """
    every = levels.expand(agent.copies, *levels.batch_size)
    first = torch.cat([every.start, every.direction.unsqueeze(-1)], -1)  # [K, N, 3]
    went = first.unsqueeze(2).repeat(1, 1, max_steps + 1, 1)
    steps = torch.zeros(every.batch_size, dtype=torch.int64, device=first.device)

    def env(place: Tensor) -> ViewMazeEnv:
        return ViewMazeEnv(every[:, place], max_steps=max_steps)

    if not len(levels):  # of which there is no environment
        return went, steps
    begin = env(torch.arange(len(levels), device=first.device))
    for step, (place, state, counts) in enumerate(
        play_episodes(agent, begin, max_steps, noise, env), 1
    ):
        went[:, place, step] = torch.cat([state["agent"], state["direction"].unsqueeze(-1)], -1)
        steps[:, place] += counts
    return went, steps


def visits(agent: ActorCritic, levels: ViewLevel, max_steps: int) -> Tensor:
    """Where K Solvers are on levels [C] when they take the most probable actions.

    Returns:
        Share of the steps of one episode after which an agent is in each cell, float32
        ``[K, C, H, W]``.
    """
    went, steps = walks(agent, levels, max_steps)
    seen = torch.zeros(*went.shape[:2], *levels.walls.shape[-2:], device=went.device)
    for step, cells in enumerate(went[..., 1:, :2].unbind(2)):
        seen += cell_plane(cells, seen.shape[-2:]) * (step < steps)[..., None, None]
    return seen / steps[..., None, None].clamp(min=1)

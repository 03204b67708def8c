"""Where a policy gets from every cell of a maze, where it spends its time, and what comes of it.

A maze with a policy per cell is a Markov chain over its cells in which the goal absorbs;
:class:`~proposer_rl.tasks.mazes.evaluation.ExactEvaluator` asks it for one number, these for all
of them. The first two take one level ``[]`` and action probabilities, float ``[4, H, W]``.
"""

from __future__ import annotations

import torch
from torch import Tensor

from proposer_rl.task import EpisodeLaw
from proposer_rl.tasks.mazes.dynamics import successors
from proposer_rl.tasks.mazes.levels import Level, cell_index, cell_plane


def success_from_cells(level: Level, policy: Tensor, max_steps: int) -> Tensor:
    """Probability of reaching the goal from every cell, each with the whole step limit.

    Returns:
        float ``[H, W]``, 1 at the goal. What it says of an obstacle has no meaning.

    Example:
        Uniformly random moves in a corridor, two steps:

        >>> level = Level.from_text("S.G")
        >>> success_from_cells(level, torch.full((4, 1, 3), 0.25), max_steps=2)
        tensor([[0.0625, 0.3750, 1.0000]])
    """
    goal = cell_plane(level.goal, level.walls.shape)
    following = successors(level)  # [4, H*W]
    chances, reached = policy.flatten(1), goal.flatten()
    for _ in range(max_steps):
        after = (chances * reached[following]).sum(0)
        reached = after.where(goal.flatten() == 0, goal.flatten())
    return reached.view_as(goal)


def expected_visits(level: Level, policy: Tensor, max_steps: int) -> Tensor:
    """Expected number of steps that an episode begins at every cell.

    Returns:
        float ``[H, W]``, 0 at the goal, where no step is taken; their sum is the expected length of
        an episode.

    Example:
        >>> level = Level.from_text("S.G")
        >>> expected_visits(level, torch.full((4, 1, 3), 0.25), max_steps=2)
        tensor([[1.7500, 0.2500, 0.0000]])
    """
    return _presence(level, policy.flatten(1), max_steps).sum(0).view(level.walls.shape)


def episode_law(
    levels: Level, policy: Tensor, values: Tensor, max_steps: int = 25, step_penalty: float = 0.01
) -> EpisodeLaw:
    """All that an episode can come to, and all steps that it can be made of.

    With p_t(c) the probability that step t + 1 begins at cell c, and g_t(c) the expectation of
    1 / (steps of the episode) for one that is at c after t of them, the weight of action a at c is

        sum over t < T of  p_t(c) policy(a | c) g_(t+1)(where a leads),

    g_t being 1 / t at the goal and g_T = 1 / T everywhere: one pass forwards and one backwards.

    Args:
        levels: Levels ``[*B]``.
        policy: Action probabilities, float ``[*B, 4, H, W]``.
        values: What a critic says of every cell, float ``[*B, H, W]``.
        max_steps: Step limit T of an episode.
        step_penalty: Cost of a step.

    Returns:
        T + 1 outcomes, of success after 1 to T steps and of none, and 4 H W steps; float64.

    Example:
        Uniformly random moves in a corridor: one step, two steps, or failure.

        >>> policy, values = torch.full((4, 1, 2), 0.25), torch.zeros(1, 2)
        >>> law = episode_law(Level.from_text("SG"), policy, values, max_steps=2)
        >>> law.outcome
        tensor([ 0.9900,  0.9800, -0.0200], dtype=torch.float64)
        >>> law.probability
        tensor([0.2500, 0.1875, 0.5625], dtype=torch.float64)
    """
    policy, values = policy.double().flatten(-2), values.double().flatten(-2)
    following = successors(levels)  # [*B, 4, H*W]
    goal = cell_index(levels.goal, levels.walls.shape[-1])[..., None, None]
    wins = following == goal
    here = _presence(levels, policy, max_steps)
    weight, share = torch.zeros_like(policy), torch.full_like(values, 1 / max_steps)
    for step in range(max_steps, 0, -1):
        after = share.unsqueeze(-2).expand_as(policy).gather(-1, following)
        ahead = policy * after.where(~wins, 1 / step)
        weight += here[step - 1].unsqueeze(-2) * ahead
        share = ahead.sum(-2)
    won = (here * (policy * wins).sum(-2)).sum(-1).movedim(0, -1)  # [*B, T], by each step
    gains = 1 - step_penalty * torch.arange(1, max_steps + 1, device=won.device).double()
    outcome = torch.cat([gains, gains[-1:] - 1])
    value = values.unsqueeze(-2).expand_as(policy)
    return EpisodeLaw(
        outcome=outcome.expand(*won.shape[:-1], -1),
        probability=torch.cat([won, 1 - won.sum(-1, keepdim=True)], -1),
        weight=weight.flatten(-2),
        reward=(wins.double() - step_penalty).flatten(-2),
        value=value.flatten(-2),
        next_value=value.gather(-1, following).where(~wins, 0.0).flatten(-2),
    )


def _presence(levels: Level, policy: Tensor, max_steps: int) -> Tensor:
    """Probability that a step begins at every cell, [max_steps, *B, H*W]: none does at the goal.

    Of levels [*B] and action probabilities float [*B, 4, H*W].
    """
    width = levels.walls.shape[-1]
    start, goal = (cell_index(cell, width).unsqueeze(-1) for cell in (levels.start, levels.goal))
    following = successors(levels).flatten(-2)  # [*B, 4*H*W]
    here = torch.zeros_like(policy[..., 0, :]).scatter_(-1, start, 1.0)
    steps = []
    for _ in range(max_steps):
        steps.append(here)
        moved = (policy * here.unsqueeze(-2)).flatten(-2)
        here = torch.zeros_like(here).scatter_add_(-1, following, moved).scatter_(-1, goal, 0.0)
    return torch.stack(steps)

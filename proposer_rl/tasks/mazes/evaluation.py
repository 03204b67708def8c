"""Evaluates policies that depend on the cell of a maze, exactly or by playing episodes.

Both evaluators have the same signature: ``evaluator(levels [*B], cell_logits [*B, 4, H, W],
generator)`` returns a tensordict of batch shape ``[*B]`` with ``"return"`` and ``"success"``. The
exact one draws nothing from the generator. :func:`success_from_cells` and :func:`expected_visits`
have exact results for every cell.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.nn.functional import pad

from proposer_rl.tasks.mazes.levels import (
    MOVES,
    Level,
    cell_index,
    cell_plane,
    cell_position,
    cells_first,
    padded_index,
    shortest_path_length,
    successors,
)
from proposer_rl.tasks.mazes.maze_env import MazeEnv


@dataclass(frozen=True)
class ExactEvaluator:
    """Computes the expected return and the probability of success without sampling.

    A maze with a policy per cell is a Markov chain over its cells in which the goal absorbs. With
    p_t(c) the probability of being at cell c before step t + 1 and T the step limit, success is
    p_T(goal) and the undiscounted return is

        p_T(goal) - step_penalty * sum over t < T of (1 - p_t(goal)),

    the sum being the expected number of steps. Rounding errors are those of float32 sums of
    ``max_steps`` terms, about 1e-6.

    Attributes:
        max_steps: Step limit of an episode.
        step_penalty: Cost of a step.
        greedy: Whether the policy takes the most probable action (of equal ones the first) or
            samples.

    Example:
        Uniformly random moves in a corridor: the goal is reached in one step or two.

        >>> level = Level.from_text("SG")
        >>> result = ExactEvaluator(max_steps=2)(level, torch.zeros(4, 1, 2))
        >>> result["success"]  # 1 - (3/4)^2
        tensor(0.4375)
        >>> result["return"]  # minus 0.01 for 1 + 3/4 steps
        tensor(0.4200)
    """

    max_steps: int = 25
    step_penalty: float = 0.01
    greedy: bool = False

    def __call__(
        self, levels: Level, cell_logits: Tensor, generator: torch.Generator | None = None
    ) -> TensorDict:
        """Evaluates one policy in each maze.

        Logits that require gradients get them where these are enabled; that takes the memory of
        ``max_steps`` distributions over the cells instead of two. A greedy policy has none.

        Returns:
            ``"return"`` and ``"success"``, ``[*B]`` each: float64 of float64 logits, else float32.
        """
        keep = cell_logits.requires_grad and torch.is_grad_enabled()
        height, width = levels.walls.shape[-2:]
        goal = cell_index(levels.goal, width).flatten()  # [N]
        stay, leave = _transitions(levels, _policy(cell_logits, self.greedy), goal)
        here = stay.new_zeros(height + 2, width + 2, len(goal))  # the rim stays empty
        start = padded_index(cell_index(levels.start, width).flatten(), width)
        here.flatten(0, 1).scatter_(0, start.unsqueeze(0), 1.0)
        after, goal = torch.zeros_like(here), padded_index(goal, width).unsqueeze(0)
        success, steps = here.new_zeros(2, goal.shape[1])
        for _ in range(self.max_steps):
            steps = steps + (1 - success)
            origin = here[1:-1, 1:-1]
            if keep:  # each step in memory of its own
                after = pad(origin * stay, (0, 0, 1, 1, 1, 1))
            else:
                torch.mul(origin, stay, out=after[1:-1, 1:-1])
            for move, chance in zip(MOVES, leave, strict=True):
                _shifted(after, move).addcmul_(origin, chance)
            here, after = after, here
            success = here.flatten(0, 1).gather(0, goal).squeeze(0)
        return _result(levels, success - self.step_penalty * steps, success)


@dataclass(frozen=True)
class RolloutEvaluator:
    """Plays episodes in :class:`MazeEnv` for mean return and share of successes.

    For levels ``[*B, E]``, all indices of ``*B`` share the random numbers of E levels: replicas of
    a Solver differ only by their policies, and the result of one does not depend on the others.

    Attributes:
        max_steps: Step limit of an episode.
        step_penalty: Cost of a step.
        episodes: Episodes in each maze, at least one, with sampled actions.
    """

    max_steps: int = 25
    step_penalty: float = 0.01
    episodes: int = 1

    @torch.no_grad()
    def __call__(
        self, levels: Level, cell_logits: Tensor, generator: torch.Generator | None = None
    ) -> TensorDict:
        """Evaluates one policy in each maze, from a generator of the CPU: float32 ``[*B]`` each."""
        batch = (self.episodes, *levels.batch_size)
        env = MazeEnv(
            levels.expand(batch), max_steps=self.max_steps, step_penalty=self.step_penalty
        )
        policy = _policy(cell_logits).flatten(-2).movedim(-2, -1)  # [*B, H*W, 4]
        cumulative = policy.cumsum(-1).expand(self.episodes, *policy.shape)
        shared = [1] * (len(batch) - 2)
        noise = (self.max_steps, self.episodes, *shared, *levels.batch_size[-1:])
        uniform = torch.rand(noise, generator=generator).to(levels.walls.device)
        state = env.reset()
        playing = torch.ones(batch, dtype=torch.bool, device=levels.walls.device)
        returns = torch.zeros_like(playing, dtype=torch.float32)
        for number in uniform:  # one for each step up to the limit
            cell = cell_index(state["agent"], levels.walls.shape[-1])[..., None, None]
            here = cumulative.gather(-2, cell.expand(*batch, 1, len(MOVES))).squeeze(-2)
            threshold = number.expand(batch).unsqueeze(-1) * here[..., -1:]
            action = (here <= threshold).sum(-1).clamp_(max=len(MOVES) - 1)
            state = env.step(state.set("action", action))["next"]
            returns += state["reward"].squeeze(-1) * playing
            playing &= ~state["terminated"].squeeze(-1)
        return _result(levels, returns.mean(0), (~playing).float().mean(0))


@torch.no_grad()
def policy_path(level: Level, cell_logits: Tensor, max_steps: int = 25) -> Tensor:
    """Returns the paths of the most probable actions from the start.

    Args:
        level: Levels ``[*B]``.
        cell_logits: float ``[*B, 4, H, W]``, action logits at every cell.
        max_steps: Steps to take.

    Returns:
        int64 ``[*B, max_steps + 1, 2]``: row and column before each step and after the last one.
        A path stays at the goal.
    """
    width = level.walls.shape[-1]
    table = successors(level)  # [*B, 4, H*W]
    action = cell_logits.argmax(-3).flatten(-2).unsqueeze(-2)  # [*B, 1, H*W]
    following = table.gather(-2, action).squeeze(-2)
    goal = cell_index(level.goal, width).unsqueeze(-1)
    following.scatter_(-1, goal, goal)
    path = [cell_index(level.start, width).unsqueeze(-1)]
    for _ in range(max_steps):
        path.append(following.gather(-1, path[-1]))
    return cell_position(torch.cat(path, dim=-1), width)


def optimal_return(levels: Level, max_steps: int = 25, step_penalty: float = 0.01) -> Tensor:
    """Returns the largest expected return of any policy, which follows a shortest path.

    With d moves on that path, step limit T and step penalty c it is 1 - c d if d <= T; the step to
    the goal has its cost, too. Otherwise every policy plays to the limit, for a return of -c T. As
    d <= T implies 1 - c d > -c T, reaching the goal is optimal at any penalty.

    Args:
        levels: Levels ``[*B]``; the goal need not be reachable.
        max_steps: Step limit of an episode.
        step_penalty: Cost of a step.

    Returns:
        float32 ``[*B]``.

    Example:
        Two moves, and a goal that cannot be reached:

        >>> optimal_return(Level.from_text(["S.G", "S#G"]), max_steps=2)
        tensor([ 0.9800, -0.0200])
    """
    length = shortest_path_length(levels)
    reached = (length >= 0) & (length <= max_steps)
    return reached.float() - step_penalty * length.where(reached, max_steps)


def worst_mean(values: Tensor, fraction: float) -> Tensor:
    """Returns the mean of the lowest values, the conditional value at risk of a uniform draw.

    With n values and m = fraction · n it is the mean of the m lowest ones. If m is not a whole
    number, the last of them counts in part (Rockafellar & Uryasev, Journal of Banking & Finance 26,
    2002).

    Args:
        values: float ``[*B, n]``.
        fraction: of the values, above 0 and at most 1.

    Returns:
        float ``[*B]``.

    Example:
        >>> worst_mean(torch.tensor([0.9, 0.1, 0.5, 0.3]), 0.5)
        tensor(0.2000)
    """
    count = fraction * values.shape[-1]
    rank = torch.arange(values.shape[-1], device=values.device, dtype=values.dtype)
    weight = (count - rank).clamp(0, 1)  # 1 for whole ones, then the part, then 0
    return (values.sort(-1).values * weight).sum(-1) / count


def _policy(cell_logits: Tensor, greedy: bool = False) -> Tensor:
    """Returns action probabilities ``[*B, 4, H, W]``, in float32 or the logits' wider dtype."""
    precise = torch.promote_types(cell_logits.dtype, torch.float32)
    if greedy:
        best = cell_logits.argmax(-3, keepdim=True)
        return torch.zeros_like(cell_logits, dtype=precise).scatter_(-3, best, 1.0)
    return cell_logits.softmax(-3, dtype=precise)


def _transitions(levels: Level, policy: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the probabilities of staying in a cell and of leaving it.

    Args:
        levels: Levels ``[*B]``, N of them.
        policy: float ``[*B, 4, H, W]``.
        goal: int64 ``[N]``, number of the goal.

    Returns:
        The probability of staying, ``[H, W, N]``, and of leaving by each action, ``[4, H, W, N]``;
        at the goal 1 and 0.
    """
    free = pad(cells_first(~levels.walls).to(policy), (0, 0, 1, 1, 1, 1))  # [H+2, W+2, N]
    leave = policy.reshape(-1, *policy.shape[-3:]).permute(1, 2, 3, 0)  # [4, H, W, N]
    leave = leave.clone(memory_format=torch.contiguous_format)
    leave.flatten(1, 2).scatter_(1, goal.expand(len(MOVES), 1, -1), 0.0)
    stay = torch.zeros_like(leave[0])
    stay.flatten(0, 1).scatter_(0, goal.unsqueeze(0), 1.0)
    for action, move in enumerate(MOVES):
        open_ahead = _shifted(free, move)
        stay += leave[action] * (1 - open_ahead)
        leave[action].mul_(open_ahead)
    return stay, leave


def _shifted(padded: Tensor, move: tuple[int, int]) -> Tensor:
    """Returns a view of a grid ``[H+2, W+2, N]``, one move on from each cell: ``[H, W, N]``."""
    (down, right), (height, width) = move, padded.shape[:2]
    return padded[1 + down : height - 1 + down, 1 + right : width - 1 + right]


def _result(levels: Level, returns: Tensor, success: Tensor) -> TensorDict:
    return TensorDict(
        {
            "return": returns.reshape(levels.batch_size),
            "success": success.reshape(levels.batch_size),
        },
        batch_size=levels.batch_size,
    )


def success_from_cells(level: Level, policy: Tensor, max_steps: int) -> Tensor:
    """Returns the probability of reaching the goal from every cell within the step limit.

    Returns:
        float ``[H, W]``, 1 at the goal, and without meaning at obstacles.

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
    """Returns the expected number of steps from every cell in an episode.

    Returns:
        float ``[H, W]``, 0 at the goal; their sum is the expected length of an episode.

    Example:
        >>> level = Level.from_text("S.G")
        >>> expected_visits(level, torch.full((4, 1, 3), 0.25), max_steps=2)
        tensor([[1.7500, 0.2500, 0.0000]])
    """
    width, chances = level.walls.shape[1], policy.flatten(1)
    start, goal = (cell_index(cell, width).unsqueeze(-1) for cell in (level.start, level.goal))
    following = successors(level).flatten()  # [4*H*W]
    here = torch.zeros_like(chances[0]).scatter_(-1, start, 1.0)
    steps = []
    for _ in range(max_steps):
        steps.append(here)
        moved = (chances * here).flatten()
        here = torch.zeros_like(here).scatter_add_(-1, following, moved).scatter_(-1, goal, 0.0)
    return torch.stack(steps).sum(0).view(level.walls.shape)

"""How well Solvers with memory do on fixed levels: they play on them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.models import ActorCritic, draw
from proposer_rl.tasks.mazes.levels import cell_plane
from proposer_rl.tasks.view_mazes.env import ViewMazeEnv
from proposer_rl.tasks.view_mazes.levels import ViewLevel

SWEEP = 16  # steps between two looks at who is still playing


class Played(NamedTuple):
    """A step of the levels on which some Solver still played a few steps before.

    Attributes:
        place: of these m levels among all, int64 [m].
        state: after the step, [K, m].
        counts: whether the step belonged to the Solver's first episode there, bool [K, m].
    """

    place: Tensor
    state: TensorDictBase
    counts: Tensor


@torch.no_grad()
def play(
    agent: ActorCritic,
    levels: ViewLevel,
    max_steps: int,
    episodes: int,
    generator: torch.Generator,
) -> TensorDict:
    """Mean return and share of successes of K Solvers over episodes on levels.

    The random numbers are those of the levels, the same for every Solver: they differ by what they
    do alone, and what one gets does not depend on the company that it is evaluated in.

    Args:
        agent: K Solvers.
        levels: Levels ``[E]``, or ``[K, E]``, each Solver's own.
        max_steps: Step limit of an episode.
        episodes: Played on each level.
        generator: Source of randomness, on the CPU.

    Returns:
        ``"return"`` and ``"success"``, float32 ``[K, E]``.
    """
    count, device = levels.batch_size[-1], levels.walls.device
    each = levels.expand(agent.copies, count)
    every: ViewLevel = torch.cat([each] * episodes, 1)  # type: ignore[assignment]
    noise = torch.rand(max_steps, every.batch_size[1], generator=generator).to(device)
    returns, success = torch.zeros(2, *every.batch_size, device=device)
    for place, state, counts in _episodes(agent, every, max_steps, noise):
        returns[:, place] += state["reward"].squeeze(-1) * counts
        success[:, place] += (state["terminated"].squeeze(-1) & counts).float()
    means = {
        name: total.unflatten(1, (episodes, count)).mean(1)
        for name, total in (("return", returns), ("success", success))
    }
    return TensorDict(means, each.batch_size)


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
        the number of steps, int64 ``[K, N]``; what comes after them means nothing.
    """
    every = levels.expand(agent.copies, *levels.batch_size)
    first = torch.cat([every.start, every.direction.unsqueeze(-1)], -1)  # [K, N, 3]
    went = first.unsqueeze(2).repeat(1, 1, max_steps + 1, 1)
    steps = torch.zeros(every.batch_size, dtype=torch.int64, device=first.device)
    for step, (place, state, counts) in enumerate(_episodes(agent, every, max_steps, noise), 1):
        now = torch.cat([state["agent"], state["direction"].unsqueeze(-1)], -1)
        went[:, place, step] = now
        steps[:, place] += counts
    return went, steps


@torch.no_grad()
def visits(agent: ActorCritic, levels: ViewLevel, max_steps: int) -> Tensor:
    """Where K Solvers are on levels [C] when they take the most probable actions.

    Returns:
        Share of the steps of one episode after which an agent is in each cell, float32
        ``[K, C, H, W]``.
    """
    every = levels.expand(agent.copies, *levels.batch_size)
    grid = levels.walls.shape[-2:]
    seen = torch.zeros(*every.batch_size, *grid, device=levels.walls.device)

    for place, state, counts in _episodes(agent, every, max_steps, None):
        seen[:, place] += cell_plane(state["agent"], grid) * counts[..., None, None]
    return seen / seen.sum((-2, -1), keepdim=True).clamp(min=1)


def _episodes(
    agent: ActorCritic,
    levels: ViewLevel,
    max_steps: int,
    noise: Tensor | None,
) -> Iterator[Played]:
    """Play one episode of each Solver on each of its levels [K, N], all at once.

    Args:
        agent: K Solvers.
        levels: of each.
        max_steps: step limit.
        noise: of the actions, as for :func:`walks`.
    """
    if not levels.batch_size[1]:
        return
    env = ViewMazeEnv(levels, max_steps=max_steps)
    state = env.reset()
    state.update(agent.no_memory(state))
    place = torch.arange(levels.batch_size[1], device=levels.walls.device)
    over = torch.zeros(levels.batch_size, dtype=torch.bool, device=levels.walls.device)
    for step in range(max_steps):
        if step % SWEEP == 0:  # levels that all Solvers have finished are left out
            left = (~over).any(0).nonzero().squeeze(1)
            if not len(left):
                return
            place, over, state = place[left], over[:, left], state[:, left]
            env = ViewMazeEnv(levels[:, place], max_steps=max_steps)
        state = agent(state)
        if noise is None:
            action = state[agent.logits_key].argmax(-1)
        else:
            given = noise[step, place].expand(state.batch_size)
            action = draw(agent.distribution(state), given)
        state = env.step(state.set(agent.action_key, action))["next"]
        yield Played(place, state, ~over)
        over = over | state["done"].squeeze(-1)

"""How well Solvers with memory do on fixed levels: they play on them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.mazes.levels import cell_plane
from proposer_rl.mazes.view.env import ViewMazeEnv
from proposer_rl.mazes.view.levels import ViewLevel
from proposer_rl.models import ActorCritic, draw

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
        generator: Source of randomness, on the levels' device.

    Returns:
        ``"return"`` and ``"success"``, float32 ``[K, E]``.
    """
    count, device = levels.batch_size[-1], levels.walls.device
    each = levels.expand(agent.copies, count)
    every: ViewLevel = torch.cat([each] * episodes, 1)  # type: ignore[assignment]
    noise = torch.rand(max_steps, every.batch_size[1], generator=generator, device=device)

    def sample(state: TensorDictBase, step: int, place: Tensor) -> Tensor:
        return draw(agent.distribution(state), noise[step, place].expand(state.batch_size))

    returns, success = torch.zeros(2, *every.batch_size, device=device)
    for place, state, counts in _episodes(agent, every, max_steps, sample):
        returns[:, place] += state["reward"].squeeze(-1) * counts
        success[:, place] += (state["terminated"].squeeze(-1) & counts).float()
    means = {
        name: total.unflatten(1, (episodes, count)).mean(1)
        for name, total in (("return", returns), ("success", success))
    }
    return TensorDict(means, each.batch_size)


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

    def best(state: TensorDictBase, step: int, place: Tensor) -> Tensor:
        return state[agent.logits_key].argmax(-1)

    for place, state, counts in _episodes(agent, every, max_steps, best):
        seen[:, place] += cell_plane(state["agent"], grid) * counts[..., None, None]
    return seen / seen.sum((-2, -1), keepdim=True).clamp(min=1)


def _episodes(
    agent: ActorCritic,
    levels: ViewLevel,
    max_steps: int,
    act: Callable[[TensorDictBase, int, Tensor], Tensor],
) -> Iterator[Played]:
    """Play one episode of each Solver on each of its levels [K, N], all at once.

    Args:
        agent: K Solvers.
        levels: of each.
        max_steps: step limit.
        act: the actions, int64 [K, m], given a state with logits [K, m], the number of the step and
            the places of the m levels.
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
        action = act(agent(state), step, place)
        state = env.step(state.set(agent.action_key, action))["next"]
        yield Played(place, state, ~over)
        over = over | state["done"].squeeze(-1)

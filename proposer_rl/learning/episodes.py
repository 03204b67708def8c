"""Plays and measures whole episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from proposer_rl.models import ActorCritic, draw_at

SEEDS = 2**62
SWEEP = 16  # steps between two checks for levels that all Solvers have finished


@torch.no_grad()
def play_episodes(
    agent: ActorCritic,
    env: EnvBase,
    max_steps: int,
    noise: Tensor | None = None,
    remake: Callable[[Tensor], EnvBase] | None = None,
) -> Iterator[tuple[Tensor, TensorDictBase, Tensor]]:
    """Plays one episode of each of K Solvers on each of its levels, all at once.

    Args:
        agent: K Solvers, with or without memory.
        env: batch [K, N].
        max_steps: of an episode.
        noise: uniform numbers [T, N, ...] to draw actions, one for each element of an action, the
            same for every Solver; None for the most probable actions.
        remake: makes an environment [K, m] of some of the levels, int64 [m]. With it, levels that
            all Solvers have finished are dropped now and then; without it they are reset, and
            played again without being counted.

    Yields:
        For each step on the m levels on which some Solver may still be playing: their places among
        all levels, int64 [m]; the state after the step, with the reward, [K, m]; and whether the
        step belongs to the Solver's first episode there, bool [K, m].
    """
    device = env.device or torch.device("cpu")
    place = torch.arange(env.batch_size[1], device=device)
    over = torch.zeros(env.batch_size, dtype=torch.bool, device=device)
    state = env.reset()
    state.update(agent.no_memory(state))
    for step in range(max_steps):
        if step % SWEEP == 0 and step and remake is not None:
            left = (~over).any(0).nonzero().squeeze(1)
            place, over, state = place[left], over[:, left], state[:, left]
            env = remake(place) if len(left) else env
        if (remake is None or step % SWEEP == 0) and bool(over.all()):
            return
        distribution = agent.distribution(agent(state))
        if noise is None:
            action = distribution.mode
        else:
            given = noise[step, place]
            action = draw_at(distribution, given.expand(len(over), *given.shape))
        after = env.step(state.set(agent.action_key, action))["next"]
        yield place, after, ~over
        over = over | after["done"].squeeze(-1)
        state = after.exclude("reward")
        if remake is None:
            state = env.maybe_reset(state)


def mean_performance(
    agent: ActorCritic,
    make_env: Callable[[Any], EnvBase],
    levels: Any,
    generator: torch.Generator,
    *,
    max_steps: int,
    episodes: int = 1,
    greedy: bool = False,
    at_once: int | None = None,
    drop_finished: bool = False,
) -> TensorDict:
    """Plays episodes of K Solvers on levels; returns mean returns and shares of successes.

    Every Solver gets the same random numbers for a level. So Solvers differ only in what they do,
    and the result of one does not depend on the others.

    Args:
        agent: K Solvers.
        make_env: makes an environment that plays levels [K, m] from its next reset on.
        levels: each Solver's levels, [K, E].
        generator: source of randomness, on the CPU.
        max_steps: of an episode.
        episodes: number of episodes on each level.
        greedy: whether to take the most probable actions instead of drawing them.
        at_once: number of episodes of each Solver that are played at once; None for all.
        drop_finished: whether to drop finished levels by making smaller environments; for
            environments that are cheap to make, and may be stepped beyond an episode's end.

    Returns:
        ``return`` and ``success``, float32 [K, E].
    """
    count = levels.batch_size[1]
    if count == 0:  # there is no environment of no levels
        empty = torch.zeros(levels.batch_size)
        return TensorDict({"return": empty, "success": empty.clone()}, levels.batch_size)
    # Played in parts, the episodes of a level belong together.
    side = 1 if at_once is None else 2
    every: Any = torch.stack([levels] * episodes, side).flatten(1, 2)
    size = at_once or every.batch_size[1]
    parts = []
    for some in every.split(size, 1):
        draws = generator
        if at_once is not None:  # what is drawn for one part does not depend on the others
            draws = torch.Generator().manual_seed(
                int(torch.randint(SEEDS, (), generator=generator))
            )
        env = make_env(some)
        device, shape = env.device, env.full_action_spec[agent.action_key].shape[1:]
        noise = None if greedy else torch.rand(max_steps, *shape, generator=draws).to(device)
        returns, success = torch.zeros(2, *some.batch_size, device=device)
        remake = (lambda place, some=some: make_env(some[:, place])) if drop_finished else None
        for place, after, counts in play_episodes(agent, env, max_steps, noise, remake):
            ended = after.get("success", after["terminated"]).squeeze(-1)
            returns[:, place] += after["reward"].squeeze(-1) * counts
            success[:, place] += (ended & counts).float()
        parts.append(TensorDict({"return": returns, "success": success}, some.batch_size))
    shape = (episodes, count) if side == 1 else (count, episodes)
    return torch.cat(parts, 1).unflatten(1, shape).mean(side)


def first_episode_return(rollout: TensorDictBase) -> Tensor:
    """Returns the sum of rewards in every environment's first episode.

    Args:
        rollout: batch [*B, T] with ``("next", "done")`` and ``("next", "reward")`` [*B, T, 1].

    Returns:
        float [*B].

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> ends = torch.tensor([[False, True, False, True]]).unsqueeze(-1)
        >>> rewards = torch.tensor([[1.0, 2.0, 4.0, 8.0]]).unsqueeze(-1)
        >>> first_episode_return(TensorDict({"next": {"done": ends, "reward": rewards}}, [1, 4]))
        tensor([3.])
    """
    return (rollout["next", "reward"].squeeze(-1) * in_first_episode(rollout)).sum(-1)


def succeeded(rollout: TensorDictBase) -> Tensor:
    """Returns whether each step of a rollout [*B, T] ended a successful episode, bool [*B, T].

    ``("next", "success")`` [*B, T, 1] says so; without such an entry, success is termination.
    """
    after = rollout["next"]
    return after.get("success", after["terminated"]).squeeze(-1)


def first_episode_success(rollout: TensorDictBase) -> Tensor:
    """Returns whether every environment's first episode ended in success within the rollout.

    Args:
        rollout: batch [*B, T] with ``("next", "done")`` [*B, T, 1], and what :func:`succeeded`
            reads.

    Returns:
        bool [*B].

    Example:
        >>> import torch
        >>> ends = torch.tensor([[False, True, False, True]]).unsqueeze(-1)
        >>> goals = torch.tensor([[False, False, False, True]]).unsqueeze(-1)
        >>> from tensordict import TensorDict
        >>> rollout = TensorDict({"next": {"done": ends, "terminated": goals}}, [1, 4])
        >>> first_episode_success(rollout)  # the second one does not count
        tensor([False])
    """
    return (succeeded(rollout) & in_first_episode(rollout)).any(-1)


def in_first_episode(rollout: TensorDictBase) -> Tensor:
    """Returns whether each step belongs to the first episode, bool [*B, T]."""
    done = rollout["next", "done"].squeeze(-1).long()
    return done.cumsum(-1) - done == 0

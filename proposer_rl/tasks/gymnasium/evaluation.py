"""What Solvers reach on levels, by playing episodes on them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.models import ActorCritic, draw
from proposer_rl.tasks.gymnasium.env import GymnasiumEnv

AT_ONCE = 64  # episodes of each Solver
SEEDS = 2**62


class EpisodeEvaluator:
    """Mean return and share of successes over whole episodes.

    Of levels [K, E] the random numbers are those of E levels, the same for every Solver: what one
    of them gets does not depend on the company that it is evaluated in.

    Args:
        make_env: makes an environment of levels that plays each of them once.
        episodes: on each level.
        greedy: whether the most probable actions are played, or drawn ones.
        reward_scale: of the environment's rewards, which is taken out of the returns.
    """

    def __init__(
        self,
        make_env: Callable[[TensorDictBase], GymnasiumEnv],
        *,
        episodes: int,
        greedy: bool,
        reward_scale: float,
    ) -> None:
        self._make_env = make_env
        self._episodes = episodes
        self._greedy = greedy
        self._reward_scale = reward_scale
        self._envs: dict[torch.Size, GymnasiumEnv] = {}

    @torch.no_grad()
    def __call__(
        self, agent: ActorCritic, levels: TensorDictBase, generator: torch.Generator
    ) -> TensorDict:
        """Play levels [K, E]: ``return`` and ``success``, float32 [K, E] each."""
        played = torch.stack([levels] * self._episodes, -1).flatten(1)  # a level's side by side
        parts = []
        for some in played.split(AT_ONCE, 1):
            seed = int(torch.randint(SEEDS, (), generator=generator))
            parts.append(self._play(agent, some, torch.Generator().manual_seed(seed)))
        results = torch.cat(parts, 1).unflatten(1, (levels.batch_size[1], self._episodes))
        return results.mean(2)

    def first_states(self, levels: TensorDictBase) -> TensorDictBase:
        """What is seen at the beginning of levels [*B]."""
        return self._env(levels).reset()

    def _play(
        self, agent: ActorCritic, levels: TensorDictBase, generator: torch.Generator
    ) -> TensorDict:
        env = self._env(levels)
        state = env.reset()
        action = env.full_action_spec[agent.action_key].shape
        playing = torch.ones(*levels.batch_size, 1, dtype=torch.bool)
        returns, success = torch.zeros_like(playing, dtype=torch.float32), ~playing
        while playing.any():
            distribution = agent.distribution(agent(state))
            uniform = torch.rand(action[1:], generator=generator).expand(action)
            chosen = distribution.mode if self._greedy else draw(distribution, uniform)
            after = env.step(state.set(agent.action_key, chosen))["next"]
            returns += after["reward"] / self._reward_scale
            success |= after["success"]
            playing &= ~after["done"]
            state = env.maybe_reset(after.exclude("reward"))
        results = {"return": returns, "success": success.float()}
        return TensorDict(results, [*levels.batch_size, 1]).squeeze(-1)

    def _env(self, levels: TensorDictBase) -> GymnasiumEnv:
        """An environment that plays these levels from its next reset on."""
        shape = levels.batch_size
        if shape not in self._envs:
            self._envs[shape] = self._make_env(levels)
        self._envs[shape].set_levels(levels)
        return self._envs[shape]


def answers(agent: ActorCritic, state: TensorDictBase) -> Tensor:
    """What Solvers would do in states [K, C]: probabilities, or means of actions, [K, C, D]."""
    logits = agent(state)[agent.logits_key]
    return logits.softmax(-1) if logits.ndim == 3 else logits[..., 0]

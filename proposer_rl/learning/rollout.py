"""Collects rollouts with TorchRL's collector, and reads each level once for all steps.

Every rollout begins with a reset, or goes on with the episodes of the one before.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import Compose, EnvBase, ExcludeTransform, TransformedEnv
from torchrl.modules import set_recurrent_mode

from proposer_rl.models import ActorCritic, draw_at, population, uniform_noise
from proposer_rl.settings import ArgumentError


class RolloutCollector:
    """Collects rollouts that begin with a reset, or go on with the episodes of the last one.

    Args:
        env: batch [*B]. Entries that the agent's encoder reads must not change until the next
            reset.
        agent: acts in it.
        horizon: number T of steps of a rollout.
        continued: whether episodes go on from rollout to rollout, and with them an agent's memory.

    Attributes:
        episodes: the environment whose episodes go on; None if they do not.
        memory: of an agent whose episodes go on, batch [*B]; None before the first rollout.

    Raises:
        ArgumentError: if episodes go on, and the agent reads its level once per rollout.
    """

    def __init__(
        self, env: EnvBase, agent: ActorCritic, horizon: int, *, continued: bool = False
    ) -> None:
        if continued and agent.level_keys:
            raise ArgumentError(
                "continue_episodes=True: this Solver reads its level once for a whole rollout; "
                "leave it False"
            )
        self.episodes = ContinuedEpisodes(env) if continued else None
        self.memory: TensorDictBase | None = None
        self._agent = agent
        self._action = env.full_action_spec[agent.action_key]
        self._horizon = horizon
        self._level = _LevelAside(*agent.level_keys) if agent.level_keys else None
        self._policy = RolloutPolicy(agent, self._level)
        acted_in = self.episodes or env
        if self._level is not None:
            acted_in = _WithoutLevel(acted_in, self._level, auto_unwrap=False)
        self._collector = Collector(
            acted_in,
            self._policy,
            frames_per_batch=env.batch_size.numel() * horizon,
            total_frames=-1,
            reset_at_each_iter=True,
            use_buffers=False,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
            no_cuda_sync=True,
        )
        self.begin_anew()  # a collector resets what it gets

    def begin_anew(self) -> None:
        """Makes the next rollout begin with a reset."""
        self.memory = None
        if self.episodes is not None:
            self.episodes.begin_anew()

    def collect(self, generators: list[torch.Generator] | None = None) -> TensorDictBase:
        """Returns a complete rollout [*B, T]; see :meth:`proposer_rl.learning.PPO.collect`."""
        device = next(self._agent.parameters()).device
        noise = uniform_noise(self._action.shape, self._horizon, generators, device)
        acted = self.act(TensorDict({"noise": noise}))
        rollout, level = acted["rollout"], acted["level"]
        for key, entry in level.items(include_nested=True, leaves_only=True):
            along_time = entry.unsqueeze(level.ndim)
            rollout.set(key, along_time.expand(*rollout.shape, *entry.shape[level.ndim :]))
        return rollout

    @torch.no_grad()
    def act(self, inputs: TensorDictBase) -> TensorDict:
        """Acts by uniform ``noise`` [T, ...]; returns ``rollout`` [*B, T] and ``level`` [*B]."""
        self._policy.begin(inputs["noise"], self.memory)
        rollout = self._collector.rollout()
        if self.episodes is not None:
            self.memory = self._policy.memory
        set_next_values(self._agent, rollout, self._policy.context)
        level = TensorDict({}, rollout.batch_size[:-1])
        if self._level is not None:
            level = self._level.entries
        return TensorDict({"rollout": rollout, "level": level})


class ContinuedEpisodes(TransformedEnv):
    """Lets episodes go on where a collector resets, after the first time.

    A new episode begins when another has ended, on the level that is set at that time. Levels can
    be set from outside at any time, or ``next_levels`` provides them.

    Args:
        env: batch [*B]; it must keep a level until the next reset.

    Attributes:
        next_levels: called when episodes begin, with bool [*B], which of them; returns the levels
            [*B] to set. None if levels are set from outside.
    """

    def __init__(self, env: EnvBase) -> None:
        super().__init__(env, Compose(), auto_unwrap=False)
        self.next_levels: Callable[[Tensor], Any] | None = None
        self.begin_anew()

    @property
    def fresh(self) -> bool:
        """Whether all episodes begin with the next reset."""
        return self._standing is None

    def begin_anew(self) -> None:
        """Makes all episodes begin with the next reset."""
        self._standing: TensorDictBase | None = None

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Begins new episodes where others have ended."""
        ended = tensordict["done"].squeeze(-1)
        if self.next_levels is not None and bool(ended.any()):
            self.base_env.set_levels(self.next_levels(ended))
        standing = self.base_env.maybe_reset(tensordict)
        self._standing = standing.copy()
        return standing

    def stand(self, levels: Any, actions: Tensor, steps: Tensor) -> None:
        """Replays actions until episodes on levels [*B] are where they were interrupted.

        The environment must be deterministic given level and actions.

        Args:
            levels: of the episodes.
            actions: the last actions of each environment, [*B, T, ...].
            steps: how many of them belong to the unfinished episode, int64 [*B].
        """
        longest = int(steps.max())
        self.base_env.set_levels(levels)
        state = self.base_env.reset()
        for left in range(longest, -1, -1):
            begins = steps == left
            if left < longest and bool(begins.any()):
                state = self.base_env.reset(state.set("_reset", begins.unsqueeze(-1)))
            if left:
                # Episodes that have not begun play as well, without effect.
                state.set("action", actions.select(steps.ndim, -left))
                _, state = self.base_env.step_and_maybe_reset(state)
        self._standing = state.copy()

    def _reset(self, tensordict: TensorDictBase | None = None, **options: Any) -> TensorDictBase:
        if self._standing is None:
            if self.next_levels is not None:
                every = torch.ones(self.batch_size, dtype=torch.bool, device=self.device)
                self.base_env.set_levels(self.next_levels(every))
            self._standing = super()._reset(tensordict, **options)
        return self._standing.copy()


@torch.no_grad()
def set_values(agent: ActorCritic, steps: TensorDictBase, level: TensorDictBase) -> None:
    """Writes the current values of steps [*B, T] on a level [*B], before and after each step."""
    context = agent.encode(level)
    with set_recurrent_mode(True):
        now = agent.decode(steps.select(*agent.step_keys), context)
    for key in (agent.value_key, *agent.memory_keys):
        steps.set(key, now.get(key))
    set_next_values(agent, steps, context)


@torch.no_grad()
def set_next_values(agent: ActorCritic, steps: TensorDictBase, context: TensorDictBase) -> None:
    """Writes the values after each of the steps [*B, T], given the context of their level [*B].

    Values use the memory after each step. If an episode goes on, the value after a step is the
    value before the next one, which an agent that reads each step by itself does not compute again.
    """
    after, key = steps.get("next").select(*agent.step_keys), agent.value_key
    value = steps.get(key)
    if agent.level_keys or not population.at_hand(value):  # to count is to wait
        steps.set(("next", key), agent.decode(after, context).get(key))
        return
    shape = (agent.copies or 1, -1)
    unknown = steps.get(("next", "done")).squeeze(-1).clone()
    unknown[..., -1] = True
    unknown = unknown.reshape(shape)
    # Every replica computes as many as the one with most; known values come out the same.
    most = int(unknown.sum(1).max())
    which = unknown.byte().argsort(dim=1, descending=True, stable=True)[:, :most]
    rows = (torch.arange(len(which)).unsqueeze(1), which)
    asked = after.reshape(shape)[rows]
    if agent.copies is None:
        asked = asked.squeeze(0)
    values = torch.cat([value[..., 1:, :], value[..., -1:, :]], -2).reshape(*unknown.shape, 1)
    values[rows] = agent.decode(asked, context).get(key).reshape(*which.shape, 1)
    steps.set(("next", key), values.view(value.shape))


class RolloutPolicy(TensorDictModuleBase):
    """The policy of the collector: reads steps off the context and acts by given noise.

    It carries an agent's memory from step to step; the agent itself resets it when an episode ends.
    Call :meth:`begin` before every rollout.

    Args:
        agent: hidden from nn.Module, so that a collector does not touch its parameters.
        level: keeps the level that a reset set aside; None if the level stays in every step.
    """

    context: TensorDictBase
    memory: TensorDictBase

    def __init__(self, agent: ActorCritic, level: _LevelAside | None = None) -> None:
        super().__init__()
        # In tuples, nn.Module does not register them.
        self._agent, self._level = (agent,), (level,)
        self.in_keys = agent.step_keys
        self.out_keys = [
            agent.action_key,
            agent.log_prob_key,
            agent.value_key,
            *agent.memory,
            *agent.memory_keys,
        ]

    def begin(self, noise: Tensor, memory: TensorDictBase | None = None) -> None:
        """Prepares the next rollout.

        Args:
            noise: uniform numbers in [0, 1), [T, ...], one for each element of T actions.
            memory: of episodes that go on, [*B]; None if all begin.
        """
        self._steps = enumerate(noise)
        self._before = memory

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes action, log-probability and value of the next step."""
        (agent,), (level,) = self._agent, self._level
        index, noise = next(self._steps)
        if index == 0:
            self.context = agent.encode(tensordict if level is None else level.entries)
            going_on = self._before
            self.memory = agent.no_memory(tensordict) if going_on is None else going_on.copy()
        tensordict.update(self.memory)
        step = agent.decode(tensordict.select(*agent.step_keys), self.context)
        distribution = agent.distribution(step)
        action = draw_at(distribution, noise)
        tensordict.set(agent.action_key, action)
        tensordict.set(agent.log_prob_key, distribution.log_prob(action))
        for before, after in zip(agent.memory, agent.memory_keys, strict=True):
            self.memory.set(before, step.get(after))
            tensordict.set(after, step.get(after))
        return tensordict.set(agent.value_key, step.get(agent.value_key))


class _LevelAside(ExcludeTransform):
    """Keeps entries of the level from being copied at every step."""

    entries: TensorDictBase

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self.entries = tensordict_reset.select(*self.excluded_keys)
        return super()._reset(tensordict, tensordict_reset)


class _WithoutLevel(TransformedEnv):
    """An environment without the entries of the level, which resets as the original does."""

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.base_env.maybe_reset(tensordict).exclude(*self.transform.excluded_keys)

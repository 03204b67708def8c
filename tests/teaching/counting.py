"""Environments whose levels are numbers, so that who played what can be seen."""

from __future__ import annotations

import io
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

import proposer_rl as prl
from proposer_rl.curricula import Batch, Curriculum

ITEMS = prl.Items(1000)


class Counting(Curriculum):
    """Levels 0, 1, 2 and so on; what came of each."""

    state = ()

    def __init__(self, *reads: str) -> None:
        self.required_results = reads
        self.count = 0
        self.seen: dict[int, tuple[float, float]] = {}
        self.rollouts: dict[int, TensorDictBase] = {}

    def propose(self, student: Any, count: int, rng: Any) -> Batch:
        numbers = torch.arange(self.count, self.count + count)
        self.count += count
        levels = TensorDict({"item": numbers}, numbers.shape)
        return Batch(levels, levels.clone())

    def observe(self, student: Any, batch: Batch, outcome: TensorDictBase) -> None:
        success = outcome.get("success", torch.full_like(outcome["return"], torch.nan))
        for i, number in enumerate(batch.notes["item"].tolist()):
            assert number not in self.seen
            self.seen[number] = float(outcome["return"][i]), float(success[i])
            if "rollout" in outcome.keys():
                self.rollouts[number] = outcome["rollout"][i]

    def load_state_dict(self, state: Any) -> None:
        """Goes on with what it has seen."""


def through_torch(state: Any) -> Any:
    """A state as a checkpoint gives it back."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def rollout(rewards: Any, ends: bool = True, **entries: Any) -> TensorDict:
    """A rollout [n, T] of rewards, whose episodes end with the last step or not yet."""
    rewards = torch.as_tensor(rewards)
    done = torch.zeros(*rewards.shape, 1, dtype=torch.bool)
    done[:, -1] = ends
    after = {"reward": rewards.unsqueeze(-1), "done": done, "terminated": done}
    return TensorDict({"next": after, **entries}, rewards.shape)


def counted(*reads: str, **how: Any) -> Any:
    """A teacher of numbers, whose curriculum notes what came of each."""
    return prl.Teacher(Counting(*reads), ITEMS, **how)


def seen(teacher: Any) -> dict[int, tuple[float, float]]:
    """Return and success of each level, when all results have been observed."""
    teacher.propose(1)
    found: dict[int, tuple[float, float]] = teacher.curriculum.seen
    return found


def length(level: Any) -> Any:
    """Steps of an episode on a level."""
    return 2 + level * 7 % 5


class LevelsEnv(EnvBase):
    """Every step on level n is rewarded with n; episodes have :func:`length`, every third fails."""

    def __init__(self, count: int | None = 4) -> None:
        super().__init__(batch_size=[] if count is None else [count])
        shape = self.batch_size
        self.level = self.played = self.steps = torch.zeros(shape, dtype=torch.int64)
        seen = Unbounded((*shape, 1))
        success = Binary(1, (*shape, 1), dtype=torch.bool)
        self.observation_spec = Composite(observation=seen, success=success, shape=shape)
        self.action_spec = Categorical(2, shape=shape)
        self.reward_spec = Unbounded((*shape, 1))

    def set_levels(self, levels: torch.Tensor) -> None:
        self.level = levels.clone()

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDict:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = torch.ones(self.batch_size, dtype=torch.bool) if mask is None else mask
        mask = mask.reshape(self.batch_size)
        self.steps = self.steps.where(~mask, 0)
        self.played = self.level.where(mask, self.played)
        never = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        seen = self.steps.unsqueeze(-1).float()
        return TensorDict({"observation": seen, "success": never}, self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self.steps = self.steps + 1
        done = (self.steps >= length(self.played)).unsqueeze(-1)
        return TensorDict(
            {
                "observation": self.steps.unsqueeze(-1).float(),
                "success": done & (self.played % 3 > 0).unsqueeze(-1),
                "reward": self.played.unsqueeze(-1).float(),
                "done": done,
                "terminated": done.clone(),
            },
            self.batch_size,
        )

    def _set_seed(self, seed: int | None) -> None:
        pass


class LevelEnv(gymnasium.Env):
    """The same in Gymnasium."""

    observation_space = gymnasium.spaces.Box(0, np.inf, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)
    level = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.steps, self.played = 0, self.level
        return np.zeros(1, np.float32), {}

    def step(self, action: int) -> Any:
        self.steps += 1
        done = self.steps >= length(self.played)
        info = {"is_success": self.played % 3 > 0} if done else {}
        return np.full(1, self.steps, np.float32), float(self.played), done, False, info


def set_level(env: Any, level: Any) -> None:
    """For either kind."""
    if isinstance(env, LevelsEnv):
        env.set_levels(level)
    else:
        env.level = int(level)


def check(seen: dict[int, tuple[float, float]]) -> None:
    """Each level has the return and the success that it gives, and no other's."""
    for number, (total, success) in seen.items():
        assert total == number * length(number), number
        assert success == (number % 3 > 0), number

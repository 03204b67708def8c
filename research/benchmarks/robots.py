"""What a teacher costs thousands of robots: the share of its calls in a run that learns."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from proposer_rl import LevelTerm, Parameters, Teacher
from proposer_rl.tasks.robots import RobotEnv

RANGES = {"step": (0.0, 0.4), "slope": (-0.25, 0.25), "speed": (0.5, 1.5)}
LIMIT = 60


class Terrain(LevelTerm):
    """Steps, slopes and commanded speeds for a :class:`Fleet`."""

    method = "terrain_levels"
    seed = 0

    def make_teacher(self) -> Teacher:
        """Returns a teacher of ten rows, to master the last."""
        space = Parameters(RANGES, bins={"step": 10}, target={"step": (0.36, 0.4)})
        return Teacher(self.method, space, seed=self.seed, device=self.env.device)

    def results(self, env_ids: Tensor) -> tuple[Tensor, Tensor]:
        """Returns how well the robots followed the command, and whether they came far enough."""
        return self.env.returns[env_ids], self.env.success[env_ids]

    def set_levels(self, env_ids: Tensor, levels: Any) -> None:
        """Sets the terrain of some robots."""
        for name, entry in levels.items():
            self.env.level[name][env_ids] = entry.float()


class Fleet:
    """Robots each of which begins anew where its episode ends; the interface of ``rsl_rl``.

    Args:
        count: of the robots.
        term: that gives them their terrain.
        device: of all tensors.
    """

    num_actions, max_episode_length = RobotEnv.forces, LIMIT

    def __init__(self, count: int, term: type[LevelTerm] = Terrain, device: str = "cpu") -> None:
        self.num_envs, self.device, self.cfg = count, device, {"robots": count}
        self.level = {name: torch.zeros(count, device=device) for name in RANGES}
        levels = TensorDict(self.level, [count])
        self._robots = RobotEnv(levels, max_steps=LIMIT, device=device)
        self.episode_length_buf = torch.zeros(count, dtype=torch.int64, device=device)
        self.returns = torch.zeros(count, device=device)
        self.success = torch.zeros(count, dtype=torch.bool, device=device)
        self.state = torch.zeros(count, RobotEnv.state_size, device=device)
        self.extras: dict[str, Any] = {}
        self.term = term(None, self)
        self._reset(torch.arange(count, device=device))

    def get_observations(self) -> TensorDict:
        """Returns what the robots see, [n, 8]."""
        seen = self._robots.observe(self.state, self.level)
        return TensorDict({"policy": seen}, [self.num_envs], device=self.device)

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Moves the robots, and begins anew with those whose episode has ended."""
        made = self._robots.advance(self.state, actions.clamp(-1, 1), self.level, self._chance())
        self.state = made.state
        self.episode_length_buf += 1
        self.returns += made.reward
        late = self.episode_length_buf >= LIMIT
        self.reset_buf = made.terminated | late
        self.success = made.success & late & ~made.terminated
        ended = self.reset_buf.nonzero().squeeze(1)
        if len(ended):
            self._reset(ended)
        self.extras["time_outs"] = late & ~made.terminated
        reward = LIMIT * made.reward
        return self.get_observations(), reward, self.reset_buf.long(), self.extras

    def _reset(self, env_ids: Tensor) -> None:
        told = self.term(self, env_ids)
        self.extras["log"] = {f"/curriculum/{name}": value for name, value in told.items()}
        self.state[env_ids] = self._robots.begin(self.level, self._chance())[env_ids]
        self.returns[env_ids] = 0
        self.episode_length_buf[env_ids] = 0

    def _chance(self) -> Tensor:
        return torch.rand(self.num_envs, RobotEnv.draws, device=self.device)

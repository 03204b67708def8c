"""REINFORCE on a lander in Gymnasium, in plain Python: one environment, ten parameters, sparse."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor, nn

import proposer_rl as prl
from research.loops.base import Loop

SECONDS, THRUST = 0.25, 3.0  # of a step, and the acceleration of the engine
SOFT = 1.0  # m/s at which it may touch down
WITHOUT_EFFECT = ("daylight", "dust", "frost", "haze", "pressure", "rocks", "static")


class LanderEnv(gymnasium.Env[Any, Any]):
    """A lander above the ground, with one engine that is on or off.

    A level is the ``gravity`` in m/s², the ``height`` at first in m, the seconds of fuel in the
    ``tank``, and seven parameters that change nothing. Nothing of a level is seen but what is left
    in the tank. A soft landing returns 1, everything else 0.

    Attributes:
        level: the parameters of episodes that begin from now on.
    """

    steps = 80
    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space = spaces.Discrete(2)
    ranges: ClassVar = {
        "gravity": (1.0, 2.5),
        "height": (0.5, 15.0),
        "tank": (1.0, 12.0),
        **dict.fromkeys(WITHOUT_EFFECT, (0.0, 1.0)),
    }

    def __init__(self) -> None:
        self.level: dict[str, float] = {"gravity": 1.0, "height": 1.0, "tank": 1.0}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Begins an episode with a small speed, up or down."""
        super().reset(seed=seed)
        self._height, self._tank = self.level["height"], self.level["tank"]
        self._speed, self._now = self.np_random.uniform(-0.5, 0.5), 0
        return self._seen(), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Makes a step; the engine needs fuel."""
        burns = bool(action) and self._tank > 0
        self._speed += SECONDS * (THRUST * burns - self.level["gravity"])
        self._height += SECONDS * self._speed
        self._tank -= SECONDS * burns
        self._now += 1
        down = self._height <= 0
        soft = down and self._speed > -SOFT
        return self._seen(), float(soft), down, self._now >= self.steps, {"success": soft}

    def _seen(self) -> NDArray[np.float32]:
        return np.array([self._height / 10, self._speed / 3, self._tank / 6], np.float32)


def play(env: Any, policy: nn.Module, seed: int | None = None) -> tuple[Tensor, Tensor, float]:
    """Plays an episode; returns what was seen [T, 3], the actions [T], and the return."""
    seen, actions, over = [torch.from_numpy(env.reset(seed=seed)[0])], [], False
    while not over:
        with torch.no_grad():
            actions.append(torch.bernoulli(policy(seen[-1])[0].sigmoid()))
        observation, reward, terminated, truncated, _ = env.step(int(actions[-1]))
        seen.append(torch.from_numpy(observation))
        over = terminated or truncated
    return torch.stack(seen[:-1]), torch.stack(actions), reward


def train(teacher: prl.Teacher, seed: int, iterations: int) -> Iterator[nn.Module]:
    """Trains REINFORCE with a learned baseline; an iteration has 16 episodes."""

    def set_level(env: LanderEnv, level: dict[str, float]) -> None:
        env.level = level

    env = prl.TaughtEnv(LanderEnv(), teacher, set_level)
    env.reset(seed=seed)
    # Gives the log odds of burning, and the expected return.
    policy = nn.Sequential(nn.Linear(3, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh())
    policy.append(nn.Linear(64, 2))
    optimizer = torch.optim.Adam(policy.parameters(), lr=2e-3)
    for _ in range(iterations):
        episodes = [play(env, policy) for _ in range(16)]
        seen, actions = (torch.cat(part) for part in list(zip(*episodes, strict=True))[:2])
        returns = torch.cat([0 * taken + total for _, taken, total in episodes])
        odds, expected = policy(seen).unbind(-1)
        burning = torch.distributions.Bernoulli(logits=odds)
        advantage = returns - expected
        loss = advantage.square().mean() - 0.01 * burning.entropy().mean()
        loss = loss - (advantage.detach() * burning.log_prob(actions)).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        yield policy


TARGET = {"gravity": 2.0, "height": 12.0, "tank": 8.0}


def success(policy: nn.Module) -> float:
    """Returns how often a policy lands softly on the target, in a hundred episodes."""
    env = LanderEnv()
    env.level = TARGET
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return sum(play(env, policy, seed)[2] for seed in range(100)) / 100


LANDER = Loop(
    half="report",
    ranges=LanderEnv.ranges,
    target=TARGET,
    train=train,
    success=success,
    iterations=800,
    every=40,
)

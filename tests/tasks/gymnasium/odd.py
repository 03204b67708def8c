"""Environments that do one thing otherwise than Gymnasium's interface or usual ones."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces

LIMIT = 12


class Line(gym.Env[Any, Any]):
    """A point on a line; it is pushed to the left or to the right."""

    metadata: ClassVar[Any] = {"render_modes": []}
    observation_space: Any = spaces.Box(-20, 20, (2,), np.float32)
    action_space: Any = spaces.Discrete(2)
    goal: Any = 3.0

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.x, self.t = float(self.np_random.uniform(-1, 1)), 0
        return self.seen(), {}

    def seen(self) -> Any:
        return np.array([self.x, self.goal], np.float32)

    def step(self, action: Any) -> Any:
        self.x += 1.0 if action == 1 else -1.0
        self.t += 1
        done = bool(self.x >= self.goal)
        return self.seen(), float(done), done, False, {"is_success": done, "deep": {"won": done}}


def odd(**members: Any) -> str:
    """Register a line with other members, and return its name."""
    name = f"Odd{len(gym.registry)}-v0"
    gym.register(name, type("Odd", (Line,), members), max_episode_steps=LIMIT)
    return name


def with_parts(self: Line, render_mode: str | None = None) -> None:
    """Numbers of all kinds, as simulators hold them."""
    self.render_mode = render_mode
    self.gravity = np.array([0.0, 0.0, -9.81])  # type: ignore[attr-defined]
    self.mass = torch.tensor(1.0)  # type: ignore[attr-defined]
    self.sizes = [1.0, 2.0]  # type: ignore[attr-defined]
    self.config = {"wind": {"power": 1.0}}  # type: ignore[attr-defined]
    self.on = True  # type: ignore[attr-defined]
    self.counts = np.array([1, 2])  # type: ignore[attr-defined]
    self.pair = (1.0, 2.0)  # type: ignore[attr-defined]
    self.kind = "dry"  # type: ignore[attr-defined]
    self.opt = SimpleNamespace(gravity=np.array([0.0, 0.0, -9.81], np.float32))  # type: ignore


class PassesOn(Line):
    """Looks up in something inside it what it has not; what is set stays outside."""

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(render_mode)
        self.inner = SimpleNamespace(drag=1.0)

    def __getattr__(self, name: str) -> Any:
        if name == "inner":
            raise AttributeError(name)
        return getattr(self.inner, name)


class Grey(Line):
    """Bytes without channels."""

    observation_space = spaces.Box(0, 255, (20, 24), np.uint8)

    def seen(self) -> Any:
        image = np.zeros((20, 24), np.uint8)
        image[:, int(np.clip(self.x + 10, 0, 20))] = 255
        return image


class Mixed(Line):
    """Dictionaries, tuples and whole numbers, seen and taken; it moves by its Discrete part."""

    observation_space = spaces.Dict(
        {
            "camera": spaces.Box(0, 255, (3, 20, 24), np.uint8),
            "place": spaces.Box(-np.inf, np.inf, (2,), np.float64),
            "rest": spaces.Tuple((spaces.Discrete(3, start=1), spaces.MultiBinary(2))),
            "dice": spaces.MultiDiscrete([2, 3]),
        }
    )
    action_space = spaces.Dict(
        {
            "a": spaces.Discrete(2, start=5),
            "b": spaces.Tuple((spaces.MultiDiscrete([3, 2]), spaces.MultiBinary(2))),
        }
    )

    def seen(self) -> Any:
        camera = np.zeros((3, 20, 24), np.uint8)
        camera[1, :, int(np.clip(self.x + 10, 0, 20))] = 255
        return {
            "camera": camera,
            "place": np.array([self.x, self.goal]),
            "rest": (1 + self.t % 3, np.array([1, 0], np.int8)),
            "dice": np.array([1, 2]),
        }

    def step(self, action: Any) -> Any:
        assert self.action_space.contains(action)
        return super().step(action["a"] - 5)


class Robot(Line):
    """Continuous actions of several boxes, bounded, half bounded and not at all."""

    largest = float(np.finfo(np.float32).max)
    action_space = spaces.Tuple(
        (
            spaces.Box(np.array([-2.0, 0.0]), np.array([4.0, np.inf]), dtype=np.float64),
            spaces.Box(-largest, largest, (1, 2), np.float32),
        )
    )

    def step(self, action: Any) -> Any:
        self.taken = action
        return super().step(int(action[0][0] > 1))


class Truck(Line):
    """A dictionary in a dictionary is seen; two choices are made, of which the reward tells."""

    observation_space = spaces.Dict(
        place=spaces.Box(-20, 20, (2,), np.float32),
        deep=spaces.Dict(count=spaces.Discrete(LIMIT + 1)),
    )
    action_space = spaces.MultiDiscrete([2, 3])

    def seen(self) -> Any:
        return {"place": super().seen(), "deep": {"count": self.t}}

    def step(self, action: Any) -> Any:
        seen, _, *rest = super().step(action[0])
        return seen, action[1] + 0.1 * self.x, *rest


_MADE = {"PassesOn": PassesOn, "Grey": Grey, "Mixed": Mixed, "Robot": Robot, "Truck": Truck}
for _name, _made in _MADE.items():
    gym.register(f"{_name}-v0", _made, max_episode_steps=LIMIT)

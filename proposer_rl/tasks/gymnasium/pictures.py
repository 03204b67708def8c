"""Draws levels as the environment's own frames along a Solver's first episode."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor
from torch.utils._pytree import tree_map

from proposer_rl.runs.records import written
from proposer_rl.tasks.gymnasium.player import (
    GymLevel,
    LevelPlayer,
    MakeEnvironment,
    ParameterSettings,
)
from proposer_rl.tasks.gymnasium.spaces import Layout
from proposer_rl.tasks.parameters import SEED

# Most environments draw with pygame: no greeting, no window and no sound.
for name, value in {
    "PYGAME_HIDE_SUPPORT_PROMPT": "1",
    "SDL_VIDEODRIVER": "dummy",
    "SDL_AUDIODRIVER": "dummy",
}.items():
    os.environ.setdefault(name, value)

MODE = "rgb_array"
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL")
LONGER_SIDE = 150  # pixels
LATER = 3  # moments of an episode that are drawn over its start
FRAMES = "The environment's frames: the start, and fainter three later moments of the episode."
NO_FRAMES = "The environment draws no frames here; the numbers are those of the level."


class Camera:
    """Replays levels with the actions that a Solver took, and takes pictures.

    Attributes:
        works: whether the environment can draw frames, and has the packages and drivers for it.
    """

    def __init__(
        self, make: MakeEnvironment, parameters: Mapping[str, ParameterSettings], play: GymLevel
    ) -> None:
        self.works = False
        with suppress(Exception):  # a package, a display, a driver: the numbers are shown instead
            if MODE in LevelPlayer(make, parameters, play).metadata["render_modes"]:
                drawing = {**make.arguments, "render_mode": MODE}
                self._player = LevelPlayer(replace(make, arguments=drawing), parameters, play)
                self._player.reset()
                self._frame()
                self.works = True

    def picture(self, play: GymLevel, actions: Tensor | None) -> NDArray[np.uint8]:
        """Draws a level, and an episode there with actions [T, ...]: uint8 [H, W, 3]."""
        if self.works:
            try:
                return self._drawn(play, actions)
            except Exception:  # as above, of another level
                self.works = False
        return written(play.lines or [f"{SEED} {play.seed}"])

    def _drawn(self, play: GymLevel, actions: Tensor | None) -> NDArray[np.uint8]:
        self._player.play = play
        self._player.reset()
        frames = [self._frame()]
        steps = 0 if actions is None else len(actions)
        taken = None
        if actions is not None:
            spaces = self._player.observation_space, self._player.action_space
            taken = Layout(*spaces).taken(actions)
        moments = {round(part * steps / LATER) for part in range(1, LATER + 1)}
        for number in range(steps):
            self._player.step(tree_map(lambda rows, number=number: rows[number], taken))
            if number + 1 in moments:
                frames.append(self._frame())
        shares = np.ones(len(frames))
        shares[0] = 2
        return np.average(frames, 0, shares).astype(np.uint8)

    def _frame(self) -> NDArray[np.uint8]:
        with _without_display():
            frame: Any = self._player.render()
        image = Image.fromarray(frame).convert("RGB")
        image.thumbnail((LONGER_SIDE, LONGER_SIDE))
        return np.asarray(image)


@contextmanager
def _without_display() -> Iterator[None]:
    """Lets MuJoCo draw with EGL where there is no display and no setting for it.

    The setting is undone: without EGL a new process could not even import MuJoCo.
    """
    if sys.platform != "linux" or any(map(os.environ.get, DISPLAYS)):
        yield
        return
    os.environ["MUJOCO_GL"] = "egl"
    try:
        yield
    finally:
        del os.environ["MUJOCO_GL"]

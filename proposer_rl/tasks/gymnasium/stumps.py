"""Gymnasium's BipedalWalker on a track of stumps of some height and spacing.

Portelas et al. 2019 (arXiv 1910.07224) made such tracks from Gym's walker. Here stumps of one width
stand on the grass of Gymnasium's.
"""

from __future__ import annotations

from itertools import count, takewhile
from typing import Any

import Box2D
import gymnasium
from gymnasium.envs.box2d.bipedal_walker import (
    TERRAIN_LENGTH,
    TERRAIN_STARTPAD,
    TERRAIN_STEP,
    BipedalWalker,
)

GREY = (255, 255, 255), (153, 153, 153)


class BipedalStumps(BipedalWalker):  # type: ignore[misc, unused-ignore]
    """BipedalWalker on a track of stumps that every reset lays anew.

    Args:
        render_mode: as in :class:`gymnasium.Env`.

    Attributes:
        stump_height: in Box2D's metres; 0 for no stumps.
        stump_spacing: free ground between two stumps, in metres.
    """

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(render_mode)
        self.stump_height, self.stump_spacing = 0.0, 3.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins an episode in a new world, since a used one keeps an order of contacts."""
        self._destroy()
        self.world = Box2D.b2World()
        return super().reset(seed=seed, options=options)

    def _generate_terrain(self, hardcore: bool) -> None:
        super()._generate_terrain(hardcore)
        if self.stump_height <= 0:
            return
        first, last = TERRAIN_STARTPAD * TERRAIN_STEP, (TERRAIN_LENGTH - 2) * TERRAIN_STEP
        every = self.stump_spacing + TERRAIN_STEP
        for x in takewhile(lambda place: place < last, count(first, every)):
            ground = self.terrain_y[int(x / TERRAIN_STEP)]
            right, top = x + TERRAIN_STEP, ground + self.stump_height
            corners: Any = [(x, ground), (right, ground), (right, top), (x, top)]
            self.fd_polygon.shape.vertices = corners
            stump = self.world.CreateStaticBody(fixtures=self.fd_polygon)
            stump.color1, stump.color2 = GREY
            self.terrain.append(stump)


gymnasium.register("BipedalStumps-v0", f"{__name__}:BipedalStumps", max_episode_steps=2000)

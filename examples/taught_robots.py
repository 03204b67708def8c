"""Choose terrains for thousands of robots at once, on one device, with partial resets.

A few tensors stand in for a simulator of robots: it has batches and ``reset_idx(env_ids)``.

    python examples/taught_robots.py [steps]
"""

from __future__ import annotations

import sys

import torch
from torch import Tensor

import proposer_rl as prl

ENVS, LIMIT = 4096, 20
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


class Walkers:
    """Simulate points that walk, slower uphill, and fall where it is too rough."""

    def __init__(self) -> None:
        self.place, self.steps = torch.zeros(2, ENVS, device=DEVICE)
        self.skill = 0.2  # grows with every step that is walked
        space = prl.Parameters({"roughness": (0.0, 1.0), "slope": (-0.3, 0.3)}, bins=10)
        progress = prl.curricula.learning_progress(source="episodes")
        self.teacher = prl.Teacher(progress, space, device=DEVICE)
        self.ids, self.terrain = self.teacher.ask(ENVS)

    def step(self) -> None:
        fell = torch.rand(ENVS, device=DEVICE) < 0.3 * (self.terrain["roughness"] - self.skill)
        self.place += 1 - self.terrain["slope"]
        self.steps += 1
        self.skill = min(1.0, self.skill + 0.002 * float((~fell).float().mean()))
        self.reset_idx((fell | (self.steps >= LIMIT)).nonzero().squeeze(1))

    def reset_idx(self, env_ids: Tensor) -> None:
        """Tell the teacher how far these robots came, and ask for their next terrain."""
        walked = self.steps[env_ids] >= LIMIT
        self.teacher.tell(self.ids[env_ids], return_=self.place[env_ids], success=walked)
        self.ids[env_ids], self.terrain[env_ids] = self.teacher.ask(len(env_ids))
        self.place[env_ids] = self.steps[env_ids] = 0


def main(steps: int = 300) -> float:
    """Walk; print the roughness of the terrain."""
    robots = Walkers()
    for step in range(steps):
        robots.step()
        if step % 50 == 49:
            rough = robots.terrain["roughness"].mean()
            print(f"step {step}: skill {robots.skill:.2f}, roughness {rough:.2f}")
    return float(robots.terrain["roughness"].mean())


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))

"""Write your own network for the Solver: one convolution that is applied several times.

Any module without buffers can be used that maps planes [*B, 3, H, W] to action logits
[*B, 4, H, W] and values [*B, 1, H, W]. Like value iteration, this one passes the goal's value one
cell further with every application of the same weights (Tamar et al. 2016, "Value Iteration
Networks"), so that it can also act in larger mazes than those it was trained on.

    python examples/own_solver.py [updates]

To use it on the command line, write a function with MazeTask's arguments that passes on
`make_network`, and name it as `task._target_`.
"""

from __future__ import annotations

import sys

import torch
from small_mazes import report, small_task, train
from torch import Tensor, nn

from proposer_rl import ExactEvaluator, SamplingCurriculum, Streams, generate_levels
from proposer_rl.models import cell_logits, orthogonal_
from proposer_rl.tasks.mazes import planes


class Iterated(nn.Module):
    """Applies a 3x3 convolution ``steps`` times, each time adding features of the maze."""

    def __init__(self, width: int = 24, steps: int = 8) -> None:
        super().__init__()
        self.look = nn.Conv2d(3, width, 3, padding=1)
        self.step = nn.Conv2d(width, width, 3, padding=1)
        self.heads = nn.Conv2d(width, 4 + 1, 1)
        self.steps = steps
        orthogonal_(self)
        orthogonal_(self.step, 1.0)
        orthogonal_(self.heads, 0.1)

    def forward(self, planes: Tensor) -> tuple[Tensor, Tensor]:
        """Map planes [*B, 3, H, W] to logits [*B, 4, H, W] and values [*B, 1, H, W]."""
        seen = self.look(planes.flatten(0, -4))
        hidden = torch.relu(seen)
        for _ in range(self.steps):
            hidden = torch.relu(self.step(hidden) + seen)
        maps = self.heads(hidden).unflatten(0, planes.shape[:-3])
        return maps.split([4, 1], -3)


def main(updates: int = 100) -> None:
    """Train on 5x5 mazes, and evaluate on 8x8 mazes."""
    task = small_task(Iterated)
    learner = task.learner([Streams(0, "solver")])
    report(train(task, SamplingCurriculum(task.target), updates, learner))
    levels = generate_levels([0.2] * 128, 4, 8, 8, generator=Streams(1).generator())
    larger = levels.unsqueeze(0)
    outcome = ExactEvaluator(max_steps=10)(larger, cell_logits(learner.agent, planes(larger)))
    print(f"on 8x8 mazes: success {outcome['success'].mean():.3f}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))

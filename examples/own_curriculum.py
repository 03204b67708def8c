"""Write your own curriculum: levels that the Solver failed on come again.

python examples/own_curriculum.py [updates]
PYTHONPATH=examples bin/train --config-dir examples/conf +method=own_curriculum +scale=quick
"""

import sys

import torch

import proposer_rl as prl


class Again(prl.Curriculum):
    """Draws levels of a space, and repeats those of the last batch that were failed."""

    state = ("failed",)  # attributes that a checkpoint keeps

    def __init__(self, space):
        self.space, self.failed = space, space.sample(1, torch.Generator())[:0]

    def propose(self, student, count, rng):
        levels = self.space.sample(count, rng.generator("levels"))
        levels[: len(self.failed)] = self.failed[:count]
        return levels

    def observe(self, student, batch, outcome):
        self.failed = batch.levels[outcome["success"] == 0]


if __name__ == "__main__":
    updates = int(sys.argv[1]) if sys.argv[1:] else 60
    print(prl.train("maze", prl.curricula.own(Again), scale="quick", updates=updates).summary)

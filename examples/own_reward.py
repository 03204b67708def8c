"""Write your own reward: the Proposer is rewarded for levels that are solved half of the time.

A reward is a function from one training step of K Solvers to a number for each. This one is
learnability, p (1 - p), where p is the success rate on a level (Rutherford et al. 2024, "No
Regrets", sections 3 and 4). In Python, in seconds:

    python examples/own_reward.py [updates]

On the command line, by a method that names it (examples/conf/method/own_reward.yaml):

    PYTHONPATH=examples bin/train --config-dir examples/conf +method=own_reward +scale=quick
"""

from __future__ import annotations

import sys

from small_mazes import proposer_settings, report, small_task, train
from torch import Tensor

from proposer_rl.meta.rewards import TrainingStep
from proposer_rl.methods import Components, proposer


def learnability(step: TrainingStep) -> Tensor:
    """Return the mean of p (1 - p) over the levels just trained on, float [K].

    p is the share of a level's episodes ending in the rollout that reached the goal.
    """
    ends = step.rollout["next"].select("terminated", "done")
    reached, ended = (ends[key].float().sum((-2, -1)) for key in ("terminated", "done"))  # [K, P]
    p = reached / ended.clamp(min=1)
    return (p * (1 - p)).mean(-1)


def main(updates: int = 60) -> None:
    """Train a Solver on the proposals of a Proposer that is rewarded for learnability."""
    task = small_task()
    curriculum = proposer(Components(task, proposer_settings(), seed=0), reward=learnability)
    report(train(task, curriculum, updates))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))

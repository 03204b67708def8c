"""A curriculum of your own: levels that the Solver has failed on come again.

A curriculum proposes levels [K, n] and observes how the Solver fared on them. This one draws from
the target and, with some probability, gives a failed level once more. What has come in since the
last proposal waits in an inbox, which is all of its state, so that an interrupted run goes on from
a checkpoint and levels may come back in any order. In Python, at a scale of seconds:

    python examples/own_curriculum.py [updates]

On the command line, named in a method of your own (examples/conf/method/own_curriculum.yaml):

    PYTHONPATH=examples bin/train --config-dir examples/conf +method=own_curriculum +scale=quick
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import torch
from small_mazes import report, small_task, train
from tensordict import TensorDictBase

from proposer_rl import Batch, Curriculum, Streams
from proposer_rl.curricula import Inbox, Student
from proposer_rl.methods import Components
from proposer_rl.settings import Share, checked
from proposer_rl.task import Distribution


class Again(Curriculum):
    """Levels of a distribution, and those of the last batch that were failed on.

    Args:
        fresh: draws the new ones.
        probability: with which a failed level takes the place of a new one.
    """

    state = ("_inbox",)  # what a resumed run needs

    @checked
    def __init__(self, fresh: Distribution, *, probability: Share = 0.5) -> None:
        self._fresh, self._probability = fresh, probability
        self._inbox = Inbox(like=fresh.sample(1, torch.Generator())[0])

    @classmethod
    def create(cls, run: Components, **settings: Any) -> Again:
        """What it takes of a run of the command line: the target."""
        return cls(run.task.target, **settings)

    def propose(self, student: Student, count: int, streams: Sequence[Streams]) -> Batch:
        """Levels [K, n]; Solver k's draws come from its own streams."""
        levels = torch.stack([self._fresh.sample(count, s.generator("levels")) for s in streams])
        for seen in self._inbox.take():
            some = slice(min(count, seen.shape[1]))
            draws = [torch.rand(seen.shape[1], generator=s.generator("again")) for s in streams]
            again = (seen["failed"] & (torch.stack(draws) < self._probability))[:, some]
            old = seen["level"][:, some].to(levels.walls.device)  # the inbox is on the CPU
            levels[:, some] = old.where(again.to(levels.walls.device), levels[:, some])
        return self._inbox.batch(levels)

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Put the levels aside, and on which of them the first episode failed."""
        self._inbox.check(batch, outcome)
        self._inbox.put(batch, level=batch.levels, failed=outcome["success"] == 0)


def main(updates: int = 60) -> None:
    """Train a Solver on the target, half of the failed levels once more."""
    task = small_task()
    report(train(task, Again(task.target), updates))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))

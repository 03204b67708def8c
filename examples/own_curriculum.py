"""A curriculum of your own: levels that the Solver has failed on come again.

A curriculum proposes levels [K, P] and observes how the Solver fared there. This one draws from the
target and, with some probability, gives a failed level once more. What it remembers is in its
state, so that an interrupted run goes on from a checkpoint. In Python, at a scale of seconds:

    python examples/own_curriculum.py [updates]

On the command line, named in a method of your own (examples/conf/method/own_curriculum.yaml):

    PYTHONPATH=examples bin/train --config-dir examples/conf +method=own_curriculum +scale=quick
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from small_mazes import report, small_task, train
from tensordict import TensorDict

from proposer_rl import PPO, Curriculum, Proposal, SamplingCurriculum, Streams
from proposer_rl.learning import Update, first_episode_success
from proposer_rl.methods import Parts
from proposer_rl.task import Distribution
from proposer_rl.tasks.mazes import Level


class Again(Curriculum):
    """Levels of another curriculum, and those of the last update that were failed on.

    Args:
        fresh: draws the new ones.
        probability: with which a failed level takes the place of a new one.
    """

    def __init__(self, fresh: Distribution, probability: float) -> None:
        if not 0 <= probability <= 1:
            raise ValueError(f"probability must be from 0 to 1, got {probability}")
        self._fresh = SamplingCurriculum(fresh)
        self._probability = probability
        self.begin()

    def begin(self) -> None:
        """A fresh Solver has not failed on anything."""
        self._last: dict[str, Any] = {}

    def propose(self, learner: PPO, updates: int, streams: Sequence[Streams]) -> Proposal:
        """Levels [K, P]; copy k's draws come from its own streams."""
        proposal = self._fresh.propose(learner, updates, streams)
        levels = proposal.levels
        if not self._last:
            return proposal
        problems = levels.batch_size[1]
        draws = torch.stack([torch.rand(problems, generator=s.generator("again")) for s in streams])
        device = levels.walls.device  # what was remembered is on the CPU, as after a checkpoint
        again = (self._last["failed"] & (draws < self._probability)).to(device)
        last = TensorDict(self._last["levels"], levels.batch_size).to(device)
        return proposal._replace(levels=Level.from_tensordict(last).where(again, levels))

    def observe(self, learner: PPO, levels: Level, update: Update) -> None:
        """Remember the levels and on which of them the first episode failed."""
        failed = ~first_episode_success(update.rollout).cpu()
        self._last = {"levels": levels.cpu().to_tensordict().to_dict(), "failed": failed}

    def state_dict(self) -> dict[str, Any]:
        """The last update's levels and failures."""
        return {"last": self._last}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from there."""
        self._last = dict(state["last"])


def again(parts: Parts, probability: float) -> Curriculum:
    """The factory that the configuration names: from a run's parts to its curriculum."""
    return Again(parts.task.target, probability)


def main(updates: int = 60) -> None:
    """Train a Solver on the target, half of the failed levels once more."""
    task = small_task()
    report(train(task, Again(task.target, 0.5), updates))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))

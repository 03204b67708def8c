"""A Proposer that is paid the regret between two students: PAIRED."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict

from proposer_rl.curricula.choice import Choice
from proposer_rl.curricula.problem_proposer import ProblemProposer, Worth
from proposer_rl.learning import PPO, Update
from proposer_rl.models import ActorCritic
from proposer_rl.settings import PPOSettings
from proposer_rl.streams import Streams
from proposer_rl.task import Levels, Task


class PairedProposer(ProblemProposer):
    """A problem is worth what another Solver, the antagonist, gets more on it.

    PAIRED (Dennis et al. 2020, arXiv 2012.02096, algorithm 1): protagonist and antagonist train on
    the same levels, and the generator is paid

        max(0, J(antagonist, level) - J(protagonist, level)).

    Of the task's performance, which may be exact; published are the antagonist's best and the
    protagonist's mean episode. The levels are draws from the space's bins rather than built cell by
    cell, each paid by itself.

    Args:
        task: whose performance is compared, and who makes the antagonist.
        agent: see :class:`ProblemProposer`.
        settings: the same.
        probe_levels: probes C.
        choice: see :class:`ProblemProposer`.
        streams: that the antagonist's weights are drawn from.
    """

    def __init__(
        self,
        task: Task,
        agent: ActorCritic,
        settings: PPOSettings,
        *,
        streams: Streams,
        probe_levels: int = 16,
        choice: Choice | None = None,
    ) -> None:
        self.antagonist = task.learner([streams])
        self._newborn = self.antagonist.snapshot()
        super().__init__(task, agent, settings, probe_levels=probe_levels, choice=choice)

    def begin(self) -> None:
        """The antagonist begins anew, too, always with the same weights."""
        super().begin()
        self.antagonist.restore(self._newborn)

    def worth(self, learner: PPO, levels: Levels, streams: Sequence[Streams]) -> Worth:
        """The regret of each level; and what the antagonist's training on them will cost."""
        task, both = self.task, (self.antagonist, learner)
        (stream,) = streams
        with torch.no_grad():
            returns = [
                task.performance(student.agent, levels, stream.generator("regret"))["return"]
                for student in both
            ]
        regret = (returns[0] - returns[1]).clamp_min(0)
        told = {"regret": float(regret.mean()), "regret_sd": float(regret.std(correction=0))}
        self._draws = stream.generator("antagonist")
        frames = task.batch_size * self.antagonist.settings.horizon
        return Worth(regret, told, frames=frames, evaluations=2 * regret.shape[1])

    def observe(self, learner: PPO, levels: Levels, update: Update) -> None:
        """Train the antagonist on the same levels.

        Raises:
            DivergedError: if a number of it is not finite.
        """
        self.antagonist.env.set_levels(levels)
        self.antagonist.update([self._draws])
        self.antagonist.check()

    def state_dict(self) -> dict[str, Any]:
        """The antagonist too."""
        return {**super().state_dict(), "antagonist": self.antagonist.snapshot().to_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with it."""
        super().load_state_dict(state)
        self.antagonist.restore(TensorDict(state["antagonist"], [1]))

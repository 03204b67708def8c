"""Rewards of a Proposer of single problems: first-order gain, and regret (PAIRED)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula.contract import Batch, Inbox
from proposer_rl.curricula.problem_proposer import ProblemProposer
from proposer_rl.curricula.student import Student, TaskStudent
from proposer_rl.learning.settings import PPOSettings
from proposer_rl.meta.first_order import Measure
from proposer_rl.models import ActorCritic
from proposer_rl.settings import Count, Positive, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Distribution, Levels, Space


class FirstOrderProposer(ProblemProposer):
    """A problem's reward is its alignment with the target direction.

    Args:
        space, target, agent, settings, probe_levels: as of :class:`ProblemProposer`.
        target_levels: fresh levels E of the target that the direction is taken from.
        step: of the differences that tell the alignments, in learning rates.
        measure: of the target's performance; see
            :func:`~proposer_rl.meta.first_order.target_performance`.
    """

    needs = ("probe", "target_direction", "alignment")

    @checked
    def __init__(
        self,
        space: Space,
        target: Distribution,
        agent: ActorCritic,
        settings: PPOSettings,
        *,
        probe_levels: int = 16,
        target_levels: Count = 256,
        step: Positive = 1.0,
        measure: Measure = "log_success",
    ) -> None:
        super().__init__(space, target, agent, settings, probe_levels=probe_levels)
        self._target_levels, self._step, self._measure = target_levels, step, measure

    def reward(
        self, student: Student, levels: Levels, stream: Streams
    ) -> tuple[Tensor, dict[str, float]]:
        """The alignment of each level, which is evaluated on either side of the student."""
        target = self.target.sample(self._target_levels, stream.generator("target"))
        reached, direction = student.target_direction(target.unsqueeze(0), self._measure)
        aligned = student.alignment(direction, levels, self._step)
        return aligned, {
            "target_performance": float(reached.mean()),
            "alignment": float(aligned.mean()),
            "alignment_sd": float(aligned.std(correction=0)),
        }


class PairedProposer(ProblemProposer):
    """A problem's reward is what another student, the antagonist, gets more on it.

    PAIRED (Dennis et al. 2020, arXiv 2012.02096, algorithm 1): protagonist and antagonist train on
    the same levels, and the generator is rewarded

        max(0, J(antagonist, level) - J(protagonist, level)).

    Of the students' performance, which may be exact; published are the antagonist's best and the
    protagonist's mean episode. The levels are draws from the space's bins rather than built cell by
    cell, each rewarded by itself. The antagonist trains on a batch when all of it has come back, or
    32 newer ones have been proposed.

    Args:
        space, target, agent, settings, probe_levels: as of :class:`ProblemProposer`.
        antagonist: the second student.
    """

    needs = ("probe", "performance")

    def __init__(
        self,
        space: Space,
        target: Distribution,
        agent: ActorCritic,
        settings: PPOSettings,
        *,
        antagonist: TaskStudent,
        probe_levels: int = 16,
    ) -> None:
        super().__init__(space, target, agent, settings, probe_levels=probe_levels)
        self.antagonist = antagonist
        self._inbox = Inbox(target.sample(1, torch.Generator())[0])

    def reward(
        self, student: Student, levels: Levels, stream: Streams
    ) -> tuple[Tensor, dict[str, float]]:
        """The regret of each level."""
        antagonist, protagonist = (
            each.performance(levels, stream.generator("regret"))["return"]
            for each in (self.antagonist, student)
        )
        student.spend(evaluations=levels.shape[1])  # of the antagonist
        regret = (antagonist - protagonist).clamp_min(0)
        return regret, {
            "regret": float(regret.mean()),
            "regret_sd": float(regret.std(correction=0)),
        }

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Put the levels aside for the antagonist; it takes as many steps on them."""
        super().observe(student, batch, outcome)
        student.spend(frames=int(outcome["steps"][0].sum()))
        self._inbox.put(batch, level=batch.levels, seed=batch.notes["seed"])

    def _numbered(self, levels: Levels, bins: Tensor, stream: Streams) -> Batch:
        """The seed of the antagonist's actions travels with the levels."""
        seed = stream.generator("antagonist").initial_seed()
        return self._inbox.batch(levels, bins=bins, seed=torch.full(bins.shape, seed))

    def _take_in(self) -> None:
        """Train the antagonist on the batches that are complete.

        Raises:
            DivergedError: if a number of it is not finite.
        """
        for evidence in self._inbox.take(whole=True):
            generator = torch.Generator().manual_seed(int(evidence["seed"][0, 0]))
            self.antagonist.train(evidence["level"], [generator])

    def state_dict(self) -> dict[str, Any]:
        """The antagonist, too."""
        return {**super().state_dict(), "antagonist": self.antagonist.snapshot().to_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with it."""
        super().load_state_dict(state)
        self.antagonist.restore(TensorDict(state["antagonist"], [1]))

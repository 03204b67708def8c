"""The paper's Proposer, rewarded for each problem with its first-order share of the gain."""

from __future__ import annotations

from torch import Tensor

from proposer_rl.curricula.checks import one_of, real, whole
from proposer_rl.curricula.problem_proposer import ProblemProposer
from proposer_rl.curricula.student import Student
from proposer_rl.meta.first_order import MEASURES
from proposer_rl.models import ActorCritic
from proposer_rl.settings import PPOSettings
from proposer_rl.streams import Streams
from proposer_rl.task import Distribution, Levels, Space


class FirstOrderProposer(ProblemProposer):
    """A problem's reward is its alignment with the target direction.

    Args:
        space: see :class:`ProblemProposer`.
        target: the distribution that is to be mastered.
        agent: see :class:`ProblemProposer`.
        settings: the same.
        probe_levels: probes C.
        target_levels: fresh levels E of the target that the direction is taken from.
        step: of the differences that tell the alignments, in learning rates.
        measure: of the target's performance; see
            :func:`~proposer_rl.meta.first_order.target_performance`.

    Raises:
        ValueError: if a number is out of range.
    """

    def __init__(
        self,
        space: Space,
        target: Distribution,
        agent: ActorCritic,
        settings: PPOSettings,
        *,
        probe_levels: int = 16,
        target_levels: int = 256,
        step: float = 1.0,
        measure: str = "log_success",
    ) -> None:
        super().__init__(space, target, agent, settings, probe_levels=probe_levels)
        self._target_levels = whole("target_levels", target_levels, 1)
        self._step = real("step", step, above=0)
        self._measure = one_of("measure", measure, MEASURES)

    @property
    def needs(self) -> tuple[str, ...]:
        """Gradients of the exact performance, too."""
        return (*super().needs, "target_direction", "alignment")

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

"""The paper's Proposer, paid for each problem with its own first-order share of the gain."""

from __future__ import annotations

from proposer_rl.curricula.choice import Choice
from proposer_rl.curricula.first_order import require_gradients
from proposer_rl.curricula.problem_proposer import ProblemProposer, Worth
from proposer_rl.learning import PPO
from proposer_rl.meta.first_order import exact_alignment, exact_direction
from proposer_rl.models import ActorCritic
from proposer_rl.settings import PPOSettings
from proposer_rl.streams import Streams
from proposer_rl.task import Levels, Task


class FirstOrderProposer(ProblemProposer):
    """A problem is worth its alignment with the target direction.

    Args:
        task: whose target is to be mastered.
        agent: see :class:`ProblemProposer`.
        settings: the same.
        probe_levels: probes C.
        choice: see :class:`ProblemProposer`.
        target_levels: fresh levels E of the target that the direction is taken from.
        measure: of the target's performance; see
            :func:`~proposer_rl.meta.first_order.target_performance`.

    Raises:
        TypeError: if the task's performance has no gradients.
    """

    def __init__(
        self,
        task: Task,
        agent: ActorCritic,
        settings: PPOSettings,
        *,
        probe_levels: int = 16,
        choice: Choice | None = None,
        target_levels: int = 256,
        measure: str = "log_success",
    ) -> None:
        self._exact = require_gradients(task)
        super().__init__(task, agent, settings, probe_levels=probe_levels, choice=choice)
        self._target_levels, self._measure = target_levels, measure

    def worth(self, learner: PPO, levels: Levels, stream: Streams) -> Worth:
        """The alignment of each level, which is evaluated on either side of the Solver."""
        task, count = self._exact, self._target_levels
        target = task.target.sample(count, stream.generator("target")).unsqueeze(0)
        reached, direction = exact_direction(task, learner, target, self._measure)
        paid = exact_alignment(task, learner, direction, levels)[0]
        told = {
            "target_performance": float(reached),
            "alignment": float(paid.mean()),
            "alignment_sd": float(paid.std()),
        }
        return Worth(paid, told, evaluations=count + 2 * len(paid))

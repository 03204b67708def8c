"""The paper's Proposer, paid for each problem with its own first-order share of the gain."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from proposer_rl.curricula.base import Improvement
from proposer_rl.curricula.checks import one_of, real, whole
from proposer_rl.curricula.choice import Choice
from proposer_rl.curricula.first_order import require_gradients
from proposer_rl.curricula.problem_proposer import ProblemProposer, Worth
from proposer_rl.learning import PPO, located
from proposer_rl.meta.first_order import MEASURES, exact_alignment, exact_direction
from proposer_rl.models import ActorCritic
from proposer_rl.settings import PPOSettings
from proposer_rl.streams import Streams
from proposer_rl.task import Levels, Task


class FirstOrderProposer(ProblemProposer):
    """A problem is worth its alignment with the target direction.

    The policy learns from the Solver's own training; with ``copies``, before each cycle also from
    that of K copies of the Solver, each on batches of its own.

    Args:
        task: whose target is to be mastered.
        agent: see :class:`ProblemProposer`.
        settings: the same.
        probe_levels: probes C.
        choice: see :class:`ProblemProposer`.
        target_levels: fresh levels E of the target that the direction is taken from.
        step: of the differences that tell the alignments, in learning rates.
        measure: of the target's performance; see
            :func:`~proposer_rl.meta.first_order.target_performance`.
        copies: K; 0 for none.
        copy_updates: updates that each of them has before a cycle.
        on_update: called with the number of updates that the copies have had; what it raises ends
            their training.

    Raises:
        TypeError: if the task's performance has no gradients.
        ValueError: if a number is out of range.
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
        step: float = 1.0,
        measure: str = "log_success",
        copies: int = 0,
        copy_updates: int = 20,
        on_update: Callable[[int], None] = lambda done: None,
    ) -> None:
        self._exact = require_gradients(task)
        super().__init__(task, agent, settings, probe_levels=probe_levels, choice=choice)
        self._target_levels = whole("target_levels", target_levels, 1)
        self._step = real("step", step, above=0)
        self._measure = one_of("measure", measure, MEASURES)
        self._copy_updates, self._on_update = copy_updates, on_update
        count = whole("copies", copies, 0)
        self._copies = task.learner([Streams(0)] * count) if count else None

    def improve(self, learner: PPO, updates: int, streams: Sequence[Streams]) -> Improvement:
        """Tell of the last cycle; with copies, train them on the policy's batches, and it on them.

        Raises:
            DivergedError: if a number of a copy is not finite.
        """
        told, copies = super().improve(learner, updates, streams), self._copies
        if copies is None:
            return told
        (stream,) = streams
        count, batch_size = copies.env.batch_size[0], self.task.batch_size
        copies.restore(learner.snapshot().expand(count))
        for update in range(self._copy_updates):
            each = [stream.within("copy", k, update) for k in range(count)]
            _, proposal = self.draw_and_learn(copies, each)
            copies.env.set_levels(proposal.levels)
            with located(f"update {update} of the Solver's copies"):
                copies.update([s.generator("actions") for s in each])
                copies.check()
            told.frames += count * (proposal.frames + batch_size * copies.settings.horizon)
            told.evaluations += count * proposal.evaluations
            self._on_update(update + 1)
        return told

    def worth(self, learner: PPO, levels: Levels, streams: Sequence[Streams]) -> Worth:
        """The alignment of each level, which is evaluated on either side of its Solver."""
        task, count = self._exact, self._target_levels
        target = task.target.sample(count, streams[0].generator("target"))
        everywhere = target.unsqueeze(0).expand(len(streams), count)
        reached, direction = exact_direction(task, learner, everywhere, self._measure)
        paid = exact_alignment(task, learner, direction, levels, self._step)
        told = {
            "target_performance": float(reached.mean()),
            "alignment": float(paid.mean()),
            "alignment_sd": float(paid.std(correction=0)),
        }
        return Worth(paid, told, evaluations=count + 2 * paid.shape[1])

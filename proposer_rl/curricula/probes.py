"""How good Solvers are in each bin: what they reach on fixed levels of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from proposer_rl.curricula.checks import one_of, whole
from proposer_rl.learning import PPO
from proposer_rl.streams import Streams
from proposer_rl.task import NoSuccessError, Task

MEASURES = ("success", "return")


class Probes:
    """Fixed levels of every bin, each Solver's own, on which its performance is looked at.

    The levels are drawn at the first look at a Solver, from the streams of that update, and stay
    for its life. What is measured is exact where the task's performance is; otherwise all Solvers
    of a population draw from the streams of the first, so that then one of several does not do what
    it would do alone.

    Args:
        task: whose space has the bins.
        count: levels of each bin.
        measure: ``"success"`` or ``"return"``.

    Raises:
        ValueError: if a value is out of range.
    """

    def __init__(self, task: Task, count: int, measure: str) -> None:
        self._task = task
        self._count = whole("probes", count, 1)
        self.measure = one_of("measure", measure, MEASURES)
        self.forget()

    def forget(self) -> None:
        """Draw new levels at the next look."""
        self._drawn_from: list[list[Any]] = []
        self._levels: Any = None

    @torch.no_grad()
    def performance(self, learner: PPO, streams: Sequence[Streams]) -> tuple[Tensor, int]:
        """Mean performance of K Solvers in each bin, and the evaluations that it took for each.

        Args:
            learner: of the Solvers.
            streams: of the update.

        Returns:
            float32 [K, N], on the CPU; the number of levels.

        Raises:
            NoSuccessError: if success is to be measured and the task tells none.
        """
        size = self._task.space.size
        if self._levels is None:
            self._drawn_from = self._drawn_from or [s.address for s in streams]
            bins = torch.arange(size).repeat_interleave(self._count)
            own = [Streams(*address).generator("probes") for address in self._drawn_from]
            self._levels = self._task.space.generate(bins.expand(len(own), -1), own)
        draws = streams[0].generator("probe_episodes")
        found = self._task.performance(learner.agent, self._levels, draws)
        if self.measure not in found.keys():
            raise NoSuccessError(
                f"measure={self.measure}: {type(self._task).__name__} tells no success, only the "
                "return; give curriculum.measure=return"
            )
        reached = found[self.measure].unflatten(-1, (size, self._count)).mean(-1)  # [K, N]
        return reached.float().cpu(), size * self._count

    def state_dict(self) -> dict[str, Any]:
        """Which streams the levels were drawn from, so that they can be drawn again."""
        return {"drawn_from": [list(address) for address in self._drawn_from]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with the levels of a state."""
        self.forget()
        self._drawn_from = [list(address) for address in state["drawn_from"]]

"""Curricula without learning: draws from a fixed distribution, or from one after another."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from typing import Any

import torch

from proposer_rl.curricula.base import Curriculum
from proposer_rl.learning.ppo import PPO
from proposer_rl.meta.view import SampleLevels
from proposer_rl.streams import Streams


class SamplingCurriculum(Curriculum):
    """Independent draws from one distribution: the target itself, or domain randomization.

    Args:
        sample: draws levels from the distribution.
    """

    def __init__(self, sample: SampleLevels) -> None:
        self._sample = sample

    def propose(self, solver: PPO, streams: Sequence[Streams]) -> Any:
        """Fresh levels [K, P] at every update."""
        problems = solver.env.batch_size[1:].numel()
        draws = [self._sample(problems, s.generator("levels")) for s in streams]
        return torch.stack(draws)


class ScheduleCurriculum(Curriculum):
    """Curricula in a fixed order: a curriculum by hand.

    Args:
        stages: curricula, in order.
        until: number of updates after which each but the last ends, ascending.

    Raises:
        ValueError: if ``until`` is not ascending or does not fit the stages.
    """

    def __init__(self, stages: Sequence[Curriculum], until: Sequence[int]) -> None:
        if len(until) != len(stages) - 1 or sorted(set(until)) != list(until) or min(until) < 1:
            raise ValueError(
                f"{len(stages)} stages need {len(stages) - 1} ascending positive numbers of "
                f"updates, got {list(until)}"
            )
        self._stages = list(stages)
        self._until = list(until)
        self.begin()

    def begin(self) -> None:
        """Go back to the first stage."""
        self._updates = 0

    def propose(self, solver: PPO, streams: Sequence[Streams]) -> Any:
        """Levels of the present stage."""
        return self._stages[bisect_right(self._until, self._updates)].propose(solver, streams)

    def observe(self, levels: Any, rollout: Any) -> None:
        """Count the update."""
        self._updates += 1

    def state_dict(self) -> dict[str, Any]:
        """The number of updates so far."""
        return {"updates": self._updates}

    def load_state_dict(self, state: Any) -> None:
        """Go on from a saved number of updates."""
        self._updates = int(state["updates"])

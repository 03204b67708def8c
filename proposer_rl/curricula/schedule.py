"""Curricula in a fixed order: a curriculum by hand."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from typing import Any

from proposer_rl.curricula.base import Curriculum, Improvement, Proposal
from proposer_rl.learning import PPO, Update
from proposer_rl.streams import Streams


class ScheduleCurriculum(Curriculum):
    """One curriculum after another; each sees of the learner what happens during its stage.

    Args:
        stages: curricula, in order.
        until: number of the learner's updates after which each but the last ends, ascending.

    Raises:
        ValueError: if ``until`` is not ascending or does not fit the stages.
    """

    def __init__(self, stages: Sequence[Curriculum], until: Sequence[int]) -> None:
        if len(until) != len(stages) - 1 or sorted({0, *until}) != [0, *until]:
            raise ValueError(
                f"{len(stages)} stages need {len(stages) - 1} ascending positive numbers of "
                f"updates, got {list(until)}"
            )
        self._stages = list(stages)
        self._until = list(until)
        self.trains_copies = any(stage.trains_copies for stage in stages)

    def begin(self) -> None:
        """Let every stage begin."""
        for stage in self._stages:
            stage.begin()

    def propose(self, learner: PPO, updates: int, streams: Sequence[Streams]) -> Proposal:
        """What the present stage proposes."""
        return self._stage(updates).propose(learner, updates, streams)

    def observe(self, learner: PPO, levels: Any, update: Update) -> None:
        """Pass it on to the stage that has proposed the levels."""
        self._present.observe(learner, levels, update)

    def improve(self, learner: PPO, updates: int, streams: Sequence[Streams]) -> Improvement:
        """Improve the stage that the cycle begins with."""
        return self._stage(updates).improve(learner, updates, streams)

    def learnt(self) -> dict[str, Any]:
        """What the last stage that has learnt something has learnt."""
        return next(filter(None, (stage.learnt() for stage in reversed(self._stages))), {})

    def state_dict(self) -> dict[str, Any]:
        """Those of the stages."""
        return {"stages": [stage.state_dict() for stage in self._stages]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put every stage back."""
        for stage, own in zip(self._stages, state["stages"], strict=True):
            stage.load_state_dict(own)

    def close(self) -> None:
        """Close every stage."""
        for stage in self._stages:
            stage.close()

    def _stage(self, updates: int) -> Curriculum:
        self._present = self._stages[bisect_right(self._until, updates)]
        return self._present

"""Signals that tell a run to end, at a place that a test chooses."""

from __future__ import annotations

from signal import SIGTERM

from proposer_rl.runs.process import Interrupted, StopSignals


class StopAt(StopSignals):
    """A signal that comes at the n-th safe point."""

    def __init__(self, points: int) -> None:
        super().__init__()
        self.left = points

    @property
    def pending(self) -> bool:
        return self.left == 1

    def deliver(self) -> None:
        self.left -= 1
        if self.left == 0:
            raise Interrupted(SIGTERM)

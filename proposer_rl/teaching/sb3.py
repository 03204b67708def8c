"""A callback that adds a teacher's log to that of Stable-Baselines3."""

from __future__ import annotations

from numbers import Real

import torch
from stable_baselines3.common.callbacks import BaseCallback
from torch.utils._pytree import tree_leaves

from proposer_rl.teaching.teacher import Teacher


class TeacherCallback(BaseCallback):
    """Records the teacher's log after each rollout, as ``teacher/NAME``.

    An entry that is a list of numbers, such as one for each bin, is recorded as their mean.

    Args:
        teacher: the teacher of the environments that the learner trains in.
    """

    def __init__(self, teacher: Teacher) -> None:
        super().__init__()
        self._teacher = teacher

    def _on_rollout_end(self) -> None:
        for name, value in self._teacher.log().items():
            if isinstance(value, dict):  # such as the numbers of draws by bin
                continue
            leaves = tree_leaves(value, is_leaf=lambda entry: not isinstance(entry, list))
            numbers = [float(entry) for entry in leaves if isinstance(entry, Real)]
            if numbers:
                self.logger.record(f"teacher/{name}", float(torch.tensor(numbers).mean()))

    def _on_step(self) -> bool:
        return True

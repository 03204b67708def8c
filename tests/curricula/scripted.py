"""A student without an environment: what it reaches in each bin is a table that a test fills in."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from proposer_rl.curricula import Curriculum, Scorer, Student
from proposer_rl.curricula.contract import proposed
from proposer_rl.curricula.scores import Scored, unseen
from proposer_rl.streams import Streams


class Scripted(Student):
    """Levels are the numbers of their bins; success and return in a bin are ``skills`` [N]."""

    def __init__(self, skills: Tensor, batch_size: int = 32, told: str = "success") -> None:
        super().__init__()
        self.skills, self.count, self.told = skills, batch_size, told
        size = len(skills)
        self.space: Any = SimpleNamespace(
            size=size,
            axes={"place": list(range(size))},
            coordinates=torch.linspace(-1, 1, size).unsqueeze(-1),
            generate=lambda choices, generators: choices,
        )
        self.target_shares = torch.eye(size)[-1]
        self.measured: list[Tensor] = []

    def performance(self, levels: Tensor, generator: torch.Generator) -> TensorDict:
        self.measured.append(levels)
        self.spend(evaluations=len(levels))
        reached = self.skills[levels]
        return TensorDict({"return": reached} | {self.told: reached}, levels.shape)

    def exact_performance(self, levels: Tensor) -> TensorDict:
        return self.performance(levels, torch.Generator())


def reached(returns: Tensor, success: Tensor | None = None) -> TensorDict:
    """An outcome with these returns [n]; a success where one is above a half."""
    solved = returns > 0.5 if success is None else success
    return TensorDict({"return": returns, "success": solved.float()}, returns.shape)


def step(curriculum: Curriculum, student: Scripted, update: int, seed: int = 0) -> Tensor:
    """One update, in which every level's episode goes as the table says; the bins [n]."""
    batch = proposed(curriculum, student, student.count, Streams(seed, "update", update))
    curriculum.observe(student, batch, reached(student.skills[batch.levels]))
    levels: Tensor = batch.levels
    return levels


class GivenScores(Scorer):
    """Scores levels [n], whatever they are, by numbers [n] that a test gives."""

    needs = ()

    def __init__(self, numbers: Tensor) -> None:
        self._numbers = numbers.double()

    def __call__(self, *given: Any) -> Scored:
        return Scored(self._numbers, unseen(len(given[1])))

"""A task without an environment: what Solvers reach in each bin is a table that a test fills in."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from proposer_rl.curricula.base import Curriculum
from proposer_rl.curricula.scores import Scored, Scorer, unseen
from proposer_rl.learning.ppo import Update
from proposer_rl.streams import Streams


class Scripted:
    """Levels are the numbers of their bins; success and return in a bin are ``skills`` [K, N]."""

    device = torch.device("cpu")

    def __init__(self, skills: Tensor, batch_size: int = 32, told: str = "success") -> None:
        self.agent = SimpleNamespace(skills=skills)
        self.batch_size, self.told = batch_size, told
        size = skills.shape[1]
        self.space = SimpleNamespace(
            size=size,
            axes={"place": list(range(size))},
            coordinates=torch.linspace(-1, 1, size).unsqueeze(-1),
            generate=lambda choices, generators: choices,
        )
        self.target_shares = torch.eye(size)[-1]
        self.looked_at: list[Tensor] = []

    def performance(self, agent: Any, levels: Tensor, generator: torch.Generator) -> TensorDict:
        self.looked_at.append(levels)
        reached = agent.skills.gather(1, levels)
        return TensorDict({"return": reached} | {self.told: reached}, levels.shape)


def played(returns: Tensor, success: Tensor | None = None) -> Update:
    """An update whose first episodes, of two steps, have these returns [K, P]; more follow."""
    end = torch.tensor([False, True, False, True]).expand(*returns.shape, 4)
    reward = torch.stack([returns - 1, torch.ones_like(returns), *[returns + 9] * 2], -1)
    reached = end & (returns > 0.5 if success is None else success).unsqueeze(-1)
    steps = {"done": end, "terminated": reached, "reward": reward}
    rows = {name: entry.unsqueeze(-1) for name, entry in steps.items()}
    return Update(TensorDict({"next": rows}, [*returns.shape, 4]), TensorDict())


def step(curriculum: Curriculum, task: Scripted, update: int, *seeds: int) -> Tensor:
    """One update, in which every level's episode goes as the table says; the bins [K, P]."""
    streams = [Streams(seed, "update", update) for seed in seeds or range(len(task.agent.skills))]
    levels = curriculum.propose(task, update, streams).levels
    curriculum.observe(task, levels, played(task.agent.skills.gather(1, levels)))
    return levels


class GivenScores(Scorer):
    """Scores levels [K, n], whatever they are, by numbers [K, n] that a test gives."""

    def __init__(self, numbers: Tensor) -> None:
        self._numbers = numbers.double()

    def __call__(self, *given: Any) -> tuple[Scored, int, int]:
        shape = given[1].shape
        return Scored(self._numbers, *unseen(shape)), 0, shape[1]

"""A synthetic Solver whose best curriculum can be computed, for the real meta-environment.

A Solver has N skills in [0, 1]. Training on a batch of which the share x_j is of kind j moves skill
j by rate * x_j * s_(j-1) * (1 - s_j): what rests on skills that are not there teaches nothing (the
first rests on nothing), and what is mastered teaches little. The target is the last skill. Kinds
beyond the skills teach nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from types import SimpleNamespace

import torch
from tensordict import TensorDict
from torch import Tensor

from proposer_rl.learning import Update
from proposer_rl.meta.actions import Actions, Mixture
from proposer_rl.meta.env import SolverTrainingEnv, SolverView
from proposer_rl.meta.rewards import TrainingStep, performance_gain

RATE = 0.5


def train(skills: Tensor, shares: Tensor) -> Tensor:
    """Skills [*B, N] after an update on shares [*B, N]."""
    prerequisite = torch.cat([torch.ones_like(skills[..., :1]), skills[..., :-1]], -1)
    return skills + RATE * shares * prerequisite * (1 - skills)


class SkillLadder:
    """K synthetic Solvers with what the meta-environment asks of a PPO."""

    def __init__(self, copies: int, skills: int, problems: int) -> None:
        self.agent = SimpleNamespace(copies=copies, skills=torch.zeros(copies, skills))
        self.env = SimpleNamespace(
            device=torch.device("cpu"),
            batch_size=torch.Size([copies, problems]),
            set_levels=self._set_levels,
        )
        self.copies, self.horizon = copies, 1

    def _set_levels(self, levels: Tensor) -> None:
        self._levels = levels

    def update(self, generators: list[torch.Generator]) -> Update:
        skills = self.agent.skills
        taught = torch.stack([self._levels == kind for kind in range(skills.shape[1])], -1)
        self.agent.skills = train(skills, taught.float().mean(1))
        return Update(TensorDict({}, [*self.env.batch_size, 1]), TensorDict({}))

    def check(self, first: int = 0) -> None:
        """Everything is finite."""

    def snapshot(self) -> TensorDict:
        return TensorDict({"skills": self.agent.skills.clone()}, [self.agent.copies])

    def restore(self, snapshot: TensorDict) -> None:
        self.agent.skills = snapshot["skills"].clone()


class Kinds:
    """A space of levels that are nothing but the number of their kind."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.axes = {"kind": range(size)}
        self.coordinates = torch.linspace(-1, 1, size).unsqueeze(-1)

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        return torch.randint(self.size, (count,), generator=generator)

    def generate(self, choices: Tensor, generators: list[torch.Generator]) -> Tensor:
        return choices


class LadderTask:
    """What a view asks of a task: how good the last skill is, and all skills as a probe."""

    device = torch.device("cpu")

    def __init__(self, kinds: int) -> None:
        self.target = self.space = Kinds(kinds)

    def performance(
        self, agent: SimpleNamespace, levels: Tensor, generator: torch.Generator
    ) -> TensorDict:
        last = agent.skills[:, -1:].expand(-1, len(levels))
        return TensorDict({"return": last}, last.shape)

    def probe(self, agent: SimpleNamespace, levels: Tensor) -> Tensor:
        return agent.skills[:, None].expand(-1, len(levels), -1)


def ladder_env(
    actions: Callable[[Kinds], Actions],
    *,
    copies: int = 16,
    skills: int = 3,
    idle: int = 0,
    problems: int = 8,
    shuffled: bool = False,
    **lengths: int,
) -> SolverTrainingEnv:
    """The meta-environment of a ladder.

    ``idle`` kinds teach nothing; ``shuffled`` pays every copy what another one gained.
    """

    def paid(step: TrainingStep) -> Tensor:
        gain = performance_gain(step)
        return gain.roll(1) if shuffled else gain

    task = LadderTask(skills + idle)
    return SolverTrainingEnv(
        SkillLadder(copies, skills, problems),
        view=SolverView(task, validation_levels=1, probe_levels=1),
        actions=actions(task.space),
        reward=paid,
        **lengths,
    )


def any_mixture(space: Kinds) -> Mixture:
    """A number for each kind."""
    return Mixture(space, torch.eye(space.size))


def best_sequence(skills: int, updates: int) -> float:
    """The greatest last skill after so many updates of a beginner, each on any mixture.

    The result is linear in each update's shares while the others stand still, so that some sequence
    of pure batches is as good as any: all of them are tried.
    """
    sequences = torch.tensor(list(product(range(skills), repeat=updates)))
    pure = torch.eye(skills)[sequences]  # [sequences, updates, skills]
    state = torch.zeros(len(sequences), skills)
    for update in range(updates):
        state = train(state, pure[:, update])
    return float(state[:, -1].max())


def best_constant(skills: int, updates: int, problems: int) -> float:
    """The same, if all the updates have one composition of ``problems`` problems."""
    counts = [c for c in product(range(problems + 1), repeat=skills) if sum(c) == problems]
    shares = torch.tensor(counts) / problems
    state = torch.zeros(len(counts), skills)
    for _ in range(updates):
        state = train(state, shares)
    return float(state[:, -1].max())

"""PPO on point masses that fly in wind to a goal, with a reward at the goal alone or on the way."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import ClassVar

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import Bounded
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import proposer_rl as prl
from research.loops.base import EPISODES, Loop, SimulatedEnv, success_rate, taught


class WindEnv(SimulatedEnv):
    """Point masses in wind, whose goals lie in random directions.

    A level is the ``distance`` of the goal, its ``radius`` and the ``wind``.
    """

    ranges: ClassVar = {"distance": (0.5, 4.0), "wind": (0.0, 0.6), "radius": (0.15, 0.5)}
    steps, state_size, observation_size = 40, 6, 7  # the state: place, velocity, goal

    def __init__(self, count: int, dense: bool, seed: int) -> None:
        super().__init__(count, Bounded(-1, 1, (count, 2)), seed)
        self._dense = dense

    def begin(self) -> Tensor:
        """Returns masses at rest, each with its goal."""
        angle = 2 * torch.pi * torch.rand(*self.batch_size, generator=self.draw)
        goal = torch.stack([angle.cos(), angle.sin()], -1) * self.level["distance"].unsqueeze(-1)
        return torch.cat([torch.zeros(*self.batch_size, 4), goal], -1)

    def advance(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Returns the step's result: 1 at the goal, and what was gained or a small cost."""
        place, velocity, goal = state.split([2, 2, 2], -1)
        gust = 0.05 * torch.randn(*self.batch_size, 2, generator=self.draw)
        wind = torch.stack([self.level["wind"], torch.zeros(self.batch_size)], -1)
        velocity = 0.85 * velocity + 0.12 * (action.clamp(-1, 1) - wind + gust)
        moved = place + 0.5 * velocity
        before, after = ((goal - one).norm(dim=-1) for one in (place, moved))
        there = after < self.level["radius"]
        reward = there.float() + (before - after if self._dense else -0.01)
        return torch.cat([moved, velocity, goal], -1), reward, there, there

    def observe(self, state: Tensor) -> Tensor:
        """Returns the way to the goal, the velocity and the level."""
        place, velocity, goal = state.split([2, 2, 2], -1)
        return torch.cat([goal - place, velocity, torch.stack([*self.level.values()], -1)], -1)


def train(
    teacher: prl.Teacher, seed: int, iterations: int, *, count: int, dense: bool
) -> Iterator[nn.Module]:
    """Trains PPO; an iteration is a batch of as many steps as an episode has at most."""
    env = WindEnv(count, dense, seed)
    sizes = {"num_cells": [64, 64], "activation_class": nn.Tanh}
    policy = nn.Sequential(MLP(env.observation_size, 4, **sizes), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(policy, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -1, "high": 1},
        return_log_prob=True,
    )
    critic = ValueOperator(MLP(env.observation_size, 1, **sizes), ["observation"])
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic)
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.003, normalize_advantage=True)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    frames = count * env.steps
    collector = Collector(
        taught(env, teacher), actor, frames_per_batch=frames, total_frames=iterations * frames
    )
    for batch in collector:
        for _ in range(6):
            with torch.no_grad():
                advantage(batch)
            for some in torch.randperm(batch.numel()).chunk(4):
                terms = loss(batch.reshape(-1)[some])
                optimizer.zero_grad()
                sum(term for name, term in terms.items() if name.startswith("loss_")).backward()
                optimizer.step()
        yield actor
    collector.shutdown()


TARGET = {"distance": 4.0, "wind": 0.6, "radius": 0.15}


def success(actor: nn.Module) -> float:
    """Returns how often an actor reaches the target's goals."""
    return success_rate(WindEnv(EPISODES, dense=False, seed=123), TARGET, actor)


SPARSE, DENSE = (
    Loop(
        half="develop",
        ranges=WindEnv.ranges,
        target=TARGET,
        train=partial(train, count=count, dense=dense),
        success=success,
        iterations=60,
        every=5,
        block=count,
    )
    for count, dense in ((32, False), (16, True))
)

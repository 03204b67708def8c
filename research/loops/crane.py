"""SAC on cranes that carry a hanging load to a place, with a cost of every step."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import Bounded, LazyTensorStorage, ReplayBuffer
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

import proposer_rl as prl
from research.loops.base import EPISODES, Loop, SimulatedEnv, success_rate, taught

SECONDS, GRAVITY = 0.1, 9.81  # of a step
PUSH, FRICTION, DRAG = 2.0, 0.2, 0.1  # of the trolley: acceleration, friction; of the load: drag
NEAR, HELD = 0.3, 10  # m and m/s of the load to its goal, and for how many last steps


class CraneEnv(SimulatedEnv):
    """A trolley on a rail, from which a load hangs on a rope that swings.

    A level is the ``distance`` of the goal and the length of the ``rope``, in m, and the standard
    deviation of the ``gust`` that pushes the load, in m/s². No episode ends early; a success is a
    load that is near its goal, and slow, in all of the last :data:`HELD` steps.
    """

    ranges: ClassVar = {"distance": (0.5, 6.0), "rope": (0.5, 4.0), "gust": (0.0, 0.5)}
    steps, state_size, observation_size = 80, 5, 7  # trolley and angle with speeds, steps held

    def __init__(self, count: int, seed: int) -> None:
        super().__init__(count, Bounded(-1, 1, (count, 1)), seed)

    def begin(self) -> Tensor:
        """Returns loads that swing a little."""
        state = torch.zeros(*self.batch_size, self.state_size)
        state[:, 2] = 0.2 * torch.rand(*self.batch_size, generator=self.draw) - 0.1
        return state

    def advance(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Returns the step's result: the cost is the distance to the goal, and a little effort."""
        place, speed, angle, turning, held = state.unbind(-1)
        rope, action = self.level["rope"], action.squeeze(-1).clamp(-1, 1)
        gust = self.level["gust"] * torch.randn(*self.batch_size, generator=self.draw)
        push = PUSH * action - FRICTION * speed
        pull = GRAVITY * angle.sin() + (push - gust) * angle.cos()
        speed, turning = speed + SECONDS * push, turning - SECONDS * (pull / rope + DRAG * turning)
        place, angle = place + SECONDS * speed, angle + SECONDS * turning
        apart = (place + rope * angle.sin() - self.level["distance"]).abs()
        swift = (speed + rope * turning * angle.cos()).abs()
        held = torch.where((apart < NEAR) & (swift < NEAR), held + 1, 0)
        cost = 0.1 * apart + 0.01 * action.square()
        state = torch.stack([place, speed, angle, turning, held], -1)
        good = held >= HELD
        return state, -cost, good, torch.zeros_like(good)

    def observe(self, state: Tensor) -> Tensor:
        """Returns the way of the trolley to the goal, the other numbers, and rope and gust."""
        place, speed, angle, turning, _ = state.unbind(-1)
        distance, rope, gust = (self.level[name] for name in self.ranges)
        trolley, load = [(distance - place) / 3, speed], [2 * angle, turning, angle.sin() * rope]
        return torch.stack([*trolley, *load, rope / 2, gust], -1)


COUNT, STEPS, BATCH = 8, 40, 128  # environments, steps of each in an iteration, and transitions


def train(teacher: prl.Teacher, seed: int, iterations: int) -> Iterator[nn.Module]:
    """Trains SAC, one update for each step of all cranes."""
    env = CraneEnv(COUNT, seed)
    sizes = {"num_cells": [64, 64], "activation_class": nn.ReLU}
    policy = nn.Sequential(MLP(env.observation_size, 2, **sizes), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(policy, ["observation"], ["loc", "scale"]),
        spec=env.action_spec_unbatched,
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -1, "high": 1},
    )
    critic = ValueOperator(MLP(env.observation_size + 1, 1, **sizes), ["observation", "action"])
    loss = SACLoss(actor, critic, alpha_init=0.1)
    loss.make_value_estimator(gamma=0.98)
    follow = SoftUpdate(loss, tau=0.01)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    frames = COUNT * STEPS
    memory = ReplayBuffer(storage=LazyTensorStorage(100_000), batch_size=BATCH)
    collector = Collector(
        taught(env, teacher), actor, frames_per_batch=frames, total_frames=iterations * frames
    )
    for batch in collector:
        memory.extend(batch.reshape(-1))
        for _ in range(STEPS):
            terms = loss(memory.sample())
            optimizer.zero_grad()
            sum(term for name, term in terms.items() if name.startswith("loss_")).backward()
            optimizer.step()
            follow.step()
        yield actor
    collector.shutdown()


TARGET = {"distance": 5.0, "rope": 3.0, "gust": 0.25}


def success(actor: nn.Module) -> float:
    """Returns how often the mean action brings the target's load to rest at its goal."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        return success_rate(CraneEnv(EPISODES, seed=123), TARGET, actor)


CRANE = Loop(
    half="report",
    ranges=CraneEnv.ranges,
    target=TARGET,
    train=train,
    success=success,
    iterations=120,
    every=5,
)

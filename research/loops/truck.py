"""DQN on trucks that back a trailer to a dock, with a reward at the dock alone."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import torch
from tensordict.nn import TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import Categorical, LazyTensorStorage, ReplayBuffer
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, EGreedyModule, QValueActor
from torchrl.objectives import DQNLoss, SoftUpdate

import proposer_rl as prl
from research.loops.base import EPISODES, Loop, SimulatedEnv, success_rate, taught

CAB, TRAILER, STEER = 3.0, 4.0, 0.6  # two lengths, and the angle of the wheels
WIDTH, ANGLE = 2.0, 0.5  # how far the trailer may be off the dock's middle, and askew
BENT = 0.5  # the largest angle at the hitch at first
FOLDED, YARD = 1.2, 15.0  # an angle at the hitch and an offset with which an episode ends


class TruckEnv(SimulatedEnv):
    """The truck backer-upper of Nguyen and Widrow 1990, in the form of Schoenauer and Ronald 1994.

    The dock is at the origin. A level is where the trailer begins: its ``distance``, its ``offset``
    to the side, and how far it is ``turned``, in radians; the sides are random. A step goes back by
    1, steering one way, straight on or the other way.
    """

    ranges: ClassVar = {"distance": (2.0, 24.0), "offset": (0.0, 8.0), "turned": (0.0, 2.0)}
    steps, state_size, observation_size = 40, 4, 5  # the state: place, angles of trailer and hitch

    def __init__(self, count: int, seed: int) -> None:
        super().__init__(count, Categorical(3, (count,)), seed)

    def begin(self) -> Tensor:
        """Returns trucks with trailers, a little bent at the hitch."""
        chance = 2 * torch.rand(3, *self.batch_size, generator=self.draw) - 1
        offset, turned = chance[:2].sign() * torch.stack(
            [self.level["offset"], self.level["turned"]]
        )
        return torch.stack([self.level["distance"], offset, turned, BENT * chance[2]], -1)

    def advance(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Returns the step's result: an episode ends at the dock's wall, or folded up."""
        x, y, angle, hitch = state.unbind(-1)
        wheels = STEER * (action - 1)
        pushed = wheels.cos()
        x, y = x - pushed * hitch.cos() * angle.cos(), y - pushed * hitch.cos() * angle.sin()
        swing = (pushed * hitch.sin() / TRAILER).atan()
        angle, hitch = angle - swing, hitch + swing - (wheels.sin() / CAB).atan()
        wall = x <= 0
        docked = wall & (y.abs() < WIDTH) & (angle.abs() < ANGLE)
        over = wall | (hitch.abs() > FOLDED) | (y.abs() > YARD)
        return torch.stack([x, y, angle, hitch], -1), docked.float(), docked, over

    def observe(self, state: Tensor) -> Tensor:
        """Returns place and angles, each about -1 to 1."""
        x, y, angle, hitch = state.unbind(-1)
        return torch.stack([x / 12 - 1, y / 8, angle.sin(), angle.cos(), hitch], -1)


COUNT, STEPS, BATCH = 8, 25, 128  # environments, steps of each in an iteration, and transitions


def train(teacher: prl.Teacher, seed: int, iterations: int) -> Iterator[nn.Module]:
    """Trains DQN with a target network that follows, one update for each step of all trucks."""
    env = TruckEnv(COUNT, seed)
    network = MLP(env.observation_size, 3, num_cells=[64, 64], activation_class=nn.ReLU)
    actor = QValueActor(network, in_keys=["observation"], spec=env.action_spec_unbatched)
    frames = COUNT * STEPS
    explorer = EGreedyModule(
        env.action_spec, eps_end=0.05, annealing_num_steps=iterations * frames // 2
    )
    loss = DQNLoss(actor, delay_value=True, double_dqn=True, action_space="categorical")
    loss.make_value_estimator(gamma=0.98)
    follow = SoftUpdate(loss, tau=0.01)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    memory = ReplayBuffer(storage=LazyTensorStorage(50_000), batch_size=BATCH)
    collector = Collector(
        taught(env, teacher),
        TensorDictSequential(actor, explorer),
        frames_per_batch=frames,
        total_frames=iterations * frames,
    )
    for batch in collector:
        explorer.step(frames)
        memory.extend(batch.reshape(-1))
        for _ in range(STEPS):
            optimizer.zero_grad()
            loss(memory.sample())["loss"].backward()
            optimizer.step()
            follow.step()
        yield actor
    collector.shutdown()


TARGET = {"distance": 20.0, "offset": 6.0, "turned": 1.0}


def success(actor: nn.Module) -> float:
    """Returns how often the greedy actor docks on the target."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        return success_rate(TruckEnv(EPISODES, seed=123), TARGET, actor)


TRUCK = Loop(
    half="develop",
    ranges=TruckEnv.ranges,
    target=TARGET,
    train=train,
    success=success,
    iterations=200,
    every=10,
)

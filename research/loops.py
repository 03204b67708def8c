"""Curricula in training loops that are not this package's: TorchRL's stock parts and a Teacher.

Point masses fly in wind to a goal. ``sparse``: 32 of them, rewarded at the goal alone, which
uniform levels reach in 9 % of episodes at first. ``dense``: 16, rewarded for getting nearer.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import proposer_rl as prl
from proposer_rl.cli.errors import command
from research.common import write_rows

STEPS, SIZE = 40, 7
PARAMETERS = {"distance": (0.5, 4.0), "wind": (0.0, 0.6), "radius": (0.15, 0.5)}
TARGET = {"distance": 4.0, "wind": 0.6, "radius": 0.15}


@dataclass(frozen=True)
class Loop:
    """A loop: how many point masses, and whether getting nearer to the goal is rewarded."""

    masses: int
    dense: bool


LOOPS = {"sparse": Loop(32, dense=False), "dense": Loop(16, dense=True)}


class WindEnv(EnvBase):
    """Point masses in wind, whose goals lie in random directions; nothing here is this package's.

    Attributes:
        level: ``distance`` of the goals, ``wind`` and ``radius`` of the goals, float [*B] each, of
            episodes that begin from now on.
    """

    def __init__(self, masses: int, dense: bool, seed: int) -> None:
        super().__init__(batch_size=[masses])
        self.level = dict.fromkeys(PARAMETERS, torch.ones(masses))
        self._dense, self._draw = dense, torch.Generator().manual_seed(seed)
        ends = {name: Binary(1, (masses, 1), dtype=torch.bool) for name in ENDS}
        self.observation_spec = Composite(observation=Unbounded((masses, SIZE)), shape=[masses])
        self.action_spec = Bounded(-1, 1, (masses, 2))
        self.reward_spec = Unbounded((masses, 1))
        self.full_done_spec = Composite(ends, shape=[masses])
        self._state = torch.zeros(masses, 7)  # place, velocity, goal, steps

    def _set_seed(self, seed: int | None) -> None:
        self._draw.manual_seed(seed or 0)

    def _seen(self) -> Tensor:
        place, velocity, goal, _ = self._state.split([2, 2, 2, 1], -1)
        return torch.cat([goal - place, velocity, torch.stack([*self.level.values()], -1)], -1)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDict:
        angle = 2 * torch.pi * torch.rand(*self.batch_size, generator=self._draw)
        goal = torch.stack([angle.cos(), angle.sin()], -1) * self.level["distance"].unsqueeze(-1)
        begun = torch.zeros_like(self._state)
        begun[:, 4:6] = goal
        which = None if tensordict is None else tensordict.get("_reset", None)
        self._state = begun if which is None else begun.where(which, self._state)
        none = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        ends = {name: none.clone() for name in ENDS}
        return TensorDict({"observation": self._seen(), **ends}, self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        place, velocity, goal, steps = self._state.split([2, 2, 2, 1], -1)
        gust = 0.05 * torch.randn(*self.batch_size, 2, generator=self._draw)
        wind = torch.stack([self.level["wind"], torch.zeros(self.batch_size)], -1)
        velocity = 0.85 * velocity + 0.12 * (tensordict["action"].clamp(-1, 1) - wind + gust)
        moved = place + 0.5 * velocity
        before, after = ((goal - one).norm(dim=-1, keepdim=True) for one in (place, moved))
        self._state = torch.cat([moved, velocity, goal, steps + 1], -1)
        there = after < self.level["radius"].unsqueeze(-1)
        late = steps + 1 >= STEPS
        reward = there.float() + (before - after if self._dense else -0.01)
        ends = {"terminated": there, "truncated": late & ~there, "done": there | late}
        entries = {"observation": self._seen(), "reward": reward, **ends}
        return TensorDict(entries, self.batch_size)


ENDS = ("done", "terminated", "truncated")


def train(loop: Loop, curriculum: Any, seed: int, iterations: int, every: int) -> list[float]:
    """Trains PPO for some iterations; returns success on the target at every so many of them."""
    space = prl.Parameters(PARAMETERS, target=TARGET)
    teacher = prl.Teacher(curriculum, space, seed=seed, block=loop.masses)

    def set_level(env: WindEnv, levels: TensorDictBase) -> None:
        env.level = {name: levels[name].float() for name in PARAMETERS}

    torch.manual_seed(seed)
    env = WindEnv(loop.masses, loop.dense, seed)
    taught = TransformedEnv(env, prl.LevelTransform(teacher, set_level, success="terminated"))
    sizes = {"num_cells": [64, 64], "activation_class": nn.Tanh}
    policy = nn.Sequential(MLP(SIZE, 4, **sizes), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(policy, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -1, "high": 1},
        return_log_prob=True,
    )
    critic = ValueOperator(MLP(SIZE, 1, **sizes), ["observation"])
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic)
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.003, normalize_advantage=True)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    frames, found = loop.masses * STEPS, []
    collector = Collector(taught, actor, frames_per_batch=frames, total_frames=iterations * frames)
    for number, batch in enumerate(collector, 1):
        for _ in range(6):
            with torch.no_grad():
                advantage(batch)
            for some in torch.randperm(batch.numel()).chunk(4):
                terms = loss(batch.reshape(-1)[some])
                optimizer.zero_grad()
                sum(term for name, term in terms.items() if name.startswith("loss_")).backward()
                optimizer.step()
        if number % every == 0 or number == iterations:
            found.append(success(actor))
    collector.shutdown()
    return found


@torch.no_grad()
def success(actor: nn.Module, episodes: int = 256) -> float:
    """Returns how often an actor reaches the target's goals, the same ones each time."""
    env = WindEnv(episodes, dense=False, seed=123)
    env.level = {name: torch.full((episodes,), number) for name, number in TARGET.items()}
    with torch.random.fork_rng():
        torch.manual_seed(0)
        steps = env.rollout(STEPS, actor, break_when_any_done=False)
    return float(steps["next", "terminated"].any(1).float().mean())


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point; the exit codes are those of :mod:`proposer_rl.cli.errors`."""
    parser = argparse.ArgumentParser(prog="bin/research loops", description=__doc__)
    parser.add_argument("methods", nargs="+", help="names of curricula")
    parser.add_argument("--loop", choices=LOOPS, default="sparse")
    parser.add_argument("--seeds", type=int, nargs="+", default=[*range(20, 28)])
    parser.add_argument(
        "--settings",
        type=json.loads,
        default={},
        help="of the curricula, such as '{\"concentrate\": true}'",
    )
    parser.add_argument("--iterations", type=int, default=60, help="of training (60)")
    parser.add_argument("-o", "--output", type=Path, help="a JSON file for the rows")
    options = parser.parse_args(arguments)
    command(lambda: compare(options))


def compare(options: argparse.Namespace) -> None:
    """Trains every method with every seed, and prints the means over seeds."""
    torch.set_num_threads(1)
    table = Table("method", "along training", "at the end", "of each seed", title=options.loop)
    rows = []
    for method in options.methods:
        curriculum = getattr(prl.curricula, method)(**options.settings)
        found = torch.tensor(
            [
                train(LOOPS[options.loop], curriculum, seed, options.iterations, every=5)
                for seed in options.seeds
            ]
        )
        ends = found[:, -1]
        numbers = [f"{float(one.mean()):.3f}" for one in (found, ends)]
        table.add_row(method, *numbers, " ".join(f"{end:.2f}" for end in ends.tolist()))
        rows += [
            {"loop": options.loop, "method": method, "seed": seed, "success": curve}
            for seed, curve in zip(options.seeds, found.tolist(), strict=True)
        ]
        write_rows(rows, options.output)
    Console().print(table)


if __name__ == "__main__":
    main()

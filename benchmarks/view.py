"""Steps per second in the field's maze: TorchRL's interface, and MiniGrid's own environment."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.environment import through_torchrl
from benchmarks.results import Options, Result, Row
from benchmarks.timing import interleave, rate, ratio
from proposer_rl.mazes.view.env import ViewMazeEnv
from proposer_rl.mazes.view.generation import scattered_walls
from proposer_rl.mazes.view.levels import ViewLevel

MAX_STEPS = 250
WALLS = 30
FEW = 32  # of MiniGrid's environments, whose steps take equally long in any number


def view_steps(options: Options) -> Result:
    """Random actions with resets; both must get the same rewards on the same levels."""
    batch, steps, few = (FEW, 20, 20) if options.tiny else (4096, 50, 100)
    draw = torch.Generator().manual_seed(0)
    levels = scattered_walls(torch.full((batch,), WALLS), 13, 13, draw)
    env = ViewMazeEnv(levels.to(options.device), max_steps=MAX_STEPS)
    some = ViewMazeEnv(levels[:FEW], max_steps=MAX_STEPS)
    actions = torch.randint(3, (few, FEW), generator=draw)
    both = float(through_torchrl(some, actions)), through_minigrid(levels[:FEW], actions)
    if abs(both[0] - both[1]) > 1e-3:
        raise AssertionError(f"the environments differ: total rewards {both}")
    many = torch.randint(3, (steps, batch), generator=draw).to(options.device)
    seconds = interleave(
        {
            "TorchRL": lambda: through_torchrl(env, many),
            "MiniGrid": lambda: through_minigrid(levels[:FEW], actions),
        },
        options.repeats,
        options.device,
    )
    interface = f"ViewMazeEnv through TorchRL, batch {batch:,}"
    fast = rate(batch * steps, seconds["TorchRL"])
    relative = ratio(seconds["MiniGrid"], seconds["TorchRL"], batch * steps / (few * FEW))
    return Result(
        [
            Row(interface, "random actions and resets", fast, "/s", target=1e6, samples=seconds),
            Row(f"speed of {interface}", "MiniGrid's environments", relative, "x"),
        ]
    )


def through_minigrid(levels: ViewLevel, actions: Tensor) -> float:
    """Play actions [T, N] in one of MiniGrid's environments for each level; the sum of rewards."""
    from benchmarks.minigrid_env import MiniGridMaze  # an extra

    envs = [MiniGridMaze(level, MAX_STEPS) for level in levels]
    for env in envs:
        env.reset()
    total = 0.0
    for row in actions.tolist():
        for env, action in zip(envs, row, strict=True):
            _, reward, terminated, truncated, _ = env.step(action)
            total += float(reward)
            if terminated or truncated:
                env.reset()
    return total

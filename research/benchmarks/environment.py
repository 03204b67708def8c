"""Environment steps per second: TorchRL's interface, the bare dynamics, and Gymnasium."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import EnvBase

from proposer_rl.tasks.mazes import Level, MazeEnv, generate_levels, successors
from proposer_rl.tasks.mazes.levels import cell_index
from proposer_rl.tasks.point_masses import GATE, PointMassEnv
from research.benchmarks.plain_env import PlainMaze
from research.benchmarks.results import Options, Result, Row
from research.benchmarks.timing import interleave, rate, ratio

MAX_STEPS = 25
PENALTY = 0.01


def environment_steps(options: Options) -> Result:
    """Random actions, drawn while being timed, with finished mazes starting anew."""
    device, rows = options.device, []
    # Batch size, steps of a timing here and in Gymnasium, target of the first.
    sizes: list[tuple[int, int, int, float | None]] = [(128, 400, 50, None), (4096, 50, 3, 1.5e6)]
    for batch, steps, few, target in [(4, 30, 30, None)] if options.tiny else sizes:
        generator = torch.Generator(device).manual_seed(0)
        levels = generate_levels(
            torch.full((batch,), 0.4), 6, 10, 10, generator=generator, device=device
        )
        contenders = {
            "TorchRL": partial(through_torchrl, MazeEnv(levels, max_steps=MAX_STEPS)),
            "bare": partial(bare_dynamics, levels),
            "Gymnasium": partial(through_gymnasium, _gymnasium(levels.cpu())),
        }
        actions = draw_actions(min(steps, 40), batch, device)
        returns = [float(play(actions)) for play in contenders.values()]
        if max(returns) - min(returns) > 0.1:  # ten steps' penalty; rounding is a hundredth of it
            raise AssertionError(f"the environments differ: total rewards {returns}")
        counts = {"TorchRL": steps, "bare": steps, "Gymnasium": few}
        candidates = {
            name: _playing(play, counts[name], batch, device) for name, play in contenders.items()
        }
        seconds = interleave(candidates, options.repeats, device)
        interface = f"MazeEnv through TorchRL, batch {batch:,}"
        rows += [
            Row(
                interface,
                "random actions and resets",
                rate(batch * steps, seconds["TorchRL"]),
                "/s",
                target=target,
                samples=seconds,
            ),
            Row(
                f"speed of {interface}",
                "SyncVectorEnv, a plain Python maze",
                ratio(seconds["Gymnasium"], seconds["TorchRL"], steps / few),
                "x",
            ),
            Row(
                f"speed of {interface}",
                "the bare dynamics",
                ratio(seconds["bare"], seconds["TorchRL"]),
                "x",
            ),
        ]
    return Result([*rows, point_masses(4 if options.tiny else 16384, options)])


def point_masses(batch: int, options: Options) -> Row:
    """Point masses before gates of all kinds, pushed at random and begun again."""
    device = options.device
    spread = torch.linspace(0, 1, batch)
    env = PointMassEnv(TensorDict({name: 4 * spread for name in GATE}, [batch]), device=device)
    actions = torch.rand(20, batch, 2, device=device) * 2 - 1
    seconds = interleave(
        {"TorchRL": partial(through_torchrl, env, actions)}, options.repeats, device
    )
    return Row(
        f"PointMassEnv through TorchRL, batch {batch:,}",
        "random actions and resets",
        rate(batch * len(actions), seconds["TorchRL"]),
        "/s",
        target=1e6,
        samples=seconds,
    )


def draw_actions(steps: int, batch: int, device: str) -> Tensor:
    """Random actions, int64 [steps, batch]."""
    return torch.randint(4, (steps, batch), device=device)


def _playing(
    play: Callable[[Tensor], Tensor], steps: int, batch: int, device: str
) -> Callable[[], object]:
    return lambda: play(draw_actions(steps, batch, device))


@torch.no_grad()
def through_torchrl(env: EnvBase, actions: Tensor) -> Tensor:
    """Play actions [T, N, ...]; returns the sum of all rewards."""
    state = env.reset()
    total = torch.zeros(env.batch_size.numel(), 1, device=actions.device)
    for action in actions:
        step, state = env.step_and_maybe_reset(state.set("action", action))
        total += step["next", "reward"]
    return total.sum()


def bare_dynamics(levels: Level, actions: Tensor) -> Tensor:
    """The same on tensors, with nothing but the dynamics."""
    table = successors(levels).flatten(-2)
    height, width = levels.walls.shape[-2:]
    start, goal = (cell_index(cell, width).unsqueeze(-1) for cell in (levels.start, levels.goal))
    cell, count = start.clone(), torch.zeros_like(start)
    total = torch.zeros_like(start, dtype=torch.float32)
    for action in actions:
        cell = table.gather(-1, action.unsqueeze(-1) * (height * width) + cell)
        count += 1
        reached = cell == goal
        total += reached.float() - PENALTY
        done = reached | (count >= MAX_STEPS)
        cell = torch.where(done, start, cell)
        count.masked_fill_(done, 0)
    return total.sum()


def through_gymnasium(env: SyncVectorEnv, actions: Tensor) -> Tensor:
    """The same with one Python environment per maze."""
    env.reset()
    total = 0.0
    for action in actions.cpu().numpy():
        total += float(env.step(action)[1].sum())
    return torch.tensor(total)


def _gymnasium(levels: Level) -> SyncVectorEnv:
    makers = [
        partial(
            PlainMaze,
            level.walls.numpy(),
            tuple(level.start.tolist()),
            tuple(level.goal.tolist()),
            MAX_STEPS,
            PENALTY,
        )
        for level in levels
    ]
    return SyncVectorEnv(makers, copy=False, autoreset_mode=AutoresetMode.SAME_STEP)

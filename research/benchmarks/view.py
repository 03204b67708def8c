"""Steps per second in the partially observable maze: TorchRL's interface, MiniGrid's, jaxued's."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from proposer_rl.tasks.view_mazes.view_env import ViewMazeEnv
from proposer_rl.tasks.view_mazes.view_levels import ViewLevel, scattered_walls
from research.benchmarks.environment import through_torchrl
from research.benchmarks.jaxued_peer import LEAN, WAYS, WRAPPER
from research.benchmarks.peer import jaxued_maze
from research.benchmarks.results import Options, Result, Row
from research.benchmarks.timing import interleave, rate, ratio

MAX_STEPS = 250
WALLS = 30
FEW = 32  # of MiniGrid's environments, whose steps take equally long in any number
RESETS = {WRAPPER: "AutoReplayWrapper", LEAN: "resetting only what changes"}


def view_steps(options: Options) -> Result:
    """Random actions with resets; all must get the same rewards on the same levels."""
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
    result = Result(
        [
            Row(interface, "random actions and resets", fast, "/s", target=1e6, samples=seconds),
            Row(f"speed of {interface}", "MiniGrid's environments", relative, "x"),
        ]
    )
    if options.jaxued is not None:
        longer = torch.randint(3, (few if options.tiny else 2 * MAX_STEPS, FEW), generator=draw)
        sizes = [(levels, many), (levels[:FEW], longer)]
        beside = beside_jaxued(
            sizes[-1:] if options.tiny else sizes, options.jaxued, options.repeats
        )
        result.rows += beside.rows
        result.notes += beside.notes
    return result


def beside_jaxued(sizes: list[tuple[ViewLevel, Tensor]], python: str, repeats: int) -> Result:
    """Ours and jaxued's maze in turn, on the CPU, each with as many cores as torch has threads.

    Args:
        sizes: levels [N] and actions [T, N], int64, to play one after another.
        python: an interpreter that has jaxued.
        repeats: rounds of timings.

    Raises:
        AssertionError: If total rewards differ.
        RuntimeError: As :func:`research.benchmarks.peer.jaxued_maze`.
    """
    result = Result([])
    for levels, actions in sizes:
        env = ViewMazeEnv(levels, max_steps=MAX_STEPS)
        ours = float(through_torchrl(env, actions))
        with jaxued_maze(python, levels, actions, MAX_STEPS) as peer:
            for way in WAYS:
                theirs = peer.play(way)[1]  # compiles, too
                if abs(ours - theirs) > 1e-3:
                    raise AssertionError(f"the environments differ: total rewards {(ours, theirs)}")
            through = partial(through_torchrl, env, actions)
            seconds = peer.in_turn(WAYS, {"TorchRL": through}, repeats)
        interface = f"ViewMazeEnv through TorchRL, batch {len(levels):,}"
        result.rows.append(
            Row(
                interface,
                "in turn with jaxued",
                rate(actions.numel(), seconds["TorchRL"]),
                "/s",
                samples=seconds,
            )
        )
        for way, reset in RESETS.items():
            result.rows += [
                Row(
                    f"jaxued's Maze, batch {len(levels):,}",
                    f"lax.scan in jit, {reset}",
                    rate(actions.numel(), seconds[way]),
                    "/s",
                ),
                Row(
                    f"speed of {interface}",
                    f"jaxued, {reset}",
                    ratio(seconds[way], seconds["TorchRL"]),
                    "x",
                ),
            ]
        result.notes = [f"{peer.about}; torch with {torch.get_num_threads()} thread(s)."]
    return result


def through_minigrid(levels: ViewLevel, actions: Tensor) -> float:
    """Play actions [T, N] in one of MiniGrid's environments for each level; the sum of rewards."""
    from research.benchmarks.minigrid_env import MiniGridMaze  # an extra

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

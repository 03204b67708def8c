"""Tries an environment before training: Gymnasium's check, wrappers, levels and successes."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.utils.env_checker import check_env

from proposer_rl.tasks.gymnasium.environment import SuccessSettings
from proposer_rl.tasks.gymnasium.pictures import Camera
from proposer_rl.tasks.gymnasium.player import (
    GymLevel,
    LevelPlayer,
    MakeEnvironment,
    ParameterSettings,
    time_limits,
)
from proposer_rl.tasks.gymnasium.spaces import leaves
from proposer_rl.tasks.parameters import Bins
from proposer_rl.tasks.ranges import Labelled, value_text

SHORT = 64  # steps of an episode in which levels are compared
RESETS = 3  # after each of which a parameter must have its value
# Gymnasium's advice on the bounds of boxes, to which actions are scaled here anyway.
ADVICE = r"(?s).*(A Box .* space m\w+ value is|For Box action spaces)"


def check_environment(
    make: MakeEnvironment,
    parameters: Mapping[str, ParameterSettings],
    bins: Mapping[str, Bins],
    target: GymLevel,
    success: SuccessSettings,
) -> int:
    """Checks an environment by playing it, and returns the step limit of its episodes.

    It plays one episode on a level of the target, and short ones at both ends of each parameter,
    with all others as in the target; of texts and the like it plays every choice. What Gymnasium's
    ``check_env`` finds is a warning.

    Raises:
        ValueError: in a line that names the setting, if something cannot be made, set or read.
        ImportError, gymnasium.error.Error: from the environment, if it cannot be made.
    """
    _check_interface(LevelPlayer(make, parameters, target))
    if make.wrappers:
        _check_wrappers(make, parameters, target)
    player = LevelPlayer(make, parameters, target, success)
    limit = min((one._max_episode_steps for one in time_limits(player)), default=None)
    if limit is None:
        raise ValueError("max_steps: missing, and the environment has no time limit of its own")
    _check_episode(player, success, limit)
    for name, part in bins.items():
        each = isinstance(part, Labelled) or parameters[name].to is not None
        ends = part.low if each else torch.stack([part.low[0], part.high[-1]])
        some = part.named(ends)
        plays = [target._replace(values={**target.values, name: one}) for one in some]
        _check_values(player, name, plays)
    player.close()
    return limit


def _check_interface(player: LevelPlayer) -> None:
    """Runs Gymnasium's own check, and warns of what it finds."""
    player.reset()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ADVICE)
        try:
            check_env(player.unwrapped, skip_render_check=True, skip_close_check=True)
        except Exception as error:  # its assertions, and whatever an environment may raise
            reason = " ".join(str(error).split())
            warnings.warn(
                f"{player.make.env_id}: Gymnasium's check_env: {type(error).__name__}: {reason}",
                stacklevel=2,
            )
    player.close()


def _check_wrappers(
    make: MakeEnvironment, parameters: Mapping[str, ParameterSettings], play: GymLevel
) -> None:
    """Checks that the same actions on the same level have the same results a second time.

    Raises:
        ValueError: naming the wrapper from which on they have not.
    """
    for count in range(len(make.wrappers) + 1):
        player = LevelPlayer(replace(make, wrappers=make.wrappers[:count]), parameters, play)
        first, second = (list(_played(player, SHORT)) for _ in range(2))
        player.close()
        keeps = hasattr(player.env, "update_running_mean")  # also of rewards that are all zero yet
        if _same_episodes(first, second) and not keeps:
            continue
        if count == 0:  # the environment itself differs, of which check_env warns
            return
        raise ValueError(
            f"wrappers: {make.wrappers[count - 1]}: with it the same actions on the same level can "
            "have other results the second time: it keeps running statistics, or draws numbers "
            "without the seed. To normalize, use PPO's normalize_observations and normalize_rewards"
        )


def _check_episode(player: LevelPlayer, success: SuccessSettings, limit: int) -> None:
    """Plays one episode to its end, where the rule of success must find what it needs."""
    steps = list(_played(player, limit + 1))
    if success.kind == "survived" and steps[-1].truncated and player.in_time:
        warnings.warn(
            f"success.kind=survived: the environment cut an episode off after {len(steps)} steps, "
            f"before the time limit of {limit}, which is no success; if it has a time limit of its "
            "own, set max_steps to that",
            stacklevel=2,
        )


def _check_values(player: LevelPlayer, name: str, plays: list[GymLevel]) -> None:
    """Sets a parameter to values, and checks that they arrive, stay, and change something."""
    spaces = player.observation_space, player.action_space
    episodes: list[list[_Played]] = []
    for play in plays:
        for seed in range(RESETS):
            player.play = play._replace(seed=play.seed + seed)
            next(_played(player, 1))
            if (line := player.mismatches()) is not None:
                raise ValueError(
                    f"{line}, after a reset and a step: the environment overwrites it; set it in "
                    "another way, such as set: option or set: call"
                )
        player.play = play
        episodes.append(list(_played(player, SHORT)))
        now = player.observation_space, player.action_space
        if now != spaces:
            raise ValueError(
                f"parameters.{name}: all levels must have the same spaces, but "
                f"{value_text(play.values[name])} changes {spaces} to {now}"
            )
    ends = plays[0], plays[-1]
    first, last = (value_text(play.values[name]) for play in ends)
    same = first != last and _same_episodes(episodes[0], episodes[-1])
    if same and _look_alike(player, ends):
        warnings.warn(
            f"parameters.{name}: {len(episodes[0])} steps with {first} and with {last} are the "
            "same to the last digit: the environment may not read this parameter",
            stacklevel=2,
        )


def _look_alike(player: LevelPlayer, ends: Sequence[GymLevel]) -> bool:
    """Returns whether pictures show no difference; it may take skill to meet what differs."""
    camera = Camera(player.make, player.parameters, ends[0])
    first, last = (camera.picture(play, None) for play in ends)
    return not camera.works or np.array_equal(first, last)


class _Played(NamedTuple):
    seen: list[Any]
    reward: float
    terminated: bool
    truncated: bool


def _played(player: LevelPlayer, steps: int) -> Iterator[_Played]:
    """Yields the steps of an episode of random actions, the same ones every time."""
    player.reset()
    player.action_space.seed(0)
    for _ in range(steps):
        seen, reward, terminated, truncated, _ = player.step(player.action_space.sample())
        yield _Played([np.array(part) for _, part in leaves(seen)], reward, terminated, truncated)
        if terminated or truncated:
            return


def _same_episodes(one: list[_Played], other: list[_Played]) -> bool:
    return len(one) == len(other) and all(
        a[1:] == b[1:] and all(map(np.array_equal, a.seen, b.seen))
        for a, b in zip(one, other, strict=True)
    )

"""A trial before anything is trained: Gymnasium's check, wrappers, levels and successes."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from proposer_rl.tasks.gymnasium.answers import SuccessSettings
from proposer_rl.tasks.gymnasium.pictures import Camera
from proposer_rl.tasks.gymnasium.player import (
    GymLevel,
    LevelPlayer,
    MakeEnvironment,
    ParameterSettings,
    wrapper_error,
)
from proposer_rl.tasks.gymnasium.spaces import PartTaken, assembled, leaves
from proposer_rl.tasks.parameters import Bins
from proposer_rl.tasks.ranges import Labelled, value_text

SHORT = 64  # steps of an episode in which levels are compared
RESETS = 3  # after which a level must still be there
# What Gymnasium advises on boxes, whose actions are scaled here anyway.
ADVICE = r"(?s).*(A Box .* space m\w+ value is|For Box action spaces)"


def tried(
    make: MakeEnvironment,
    parameters: Mapping[str, ParameterSettings],
    bins: Mapping[str, Bins],
    target: GymLevel,
    success: SuccessSettings,
) -> int:
    """Plays an episode on a level of the target, and short ones at both ends of each parameter.

    At the ends of a parameter's bins all others are as in the target. Where it gets texts or
    the like, each is tried. What Gymnasium's ``check_env`` finds is a warning.

    Returns:
        Steps of an episode at most.

    Raises:
        ValueError: in a line that names the key, for what cannot be made, set or read.
        ImportError, gymnasium.error.Error: of the environment, if it cannot be made.
    """
    _check_interface(LevelPlayer(make, parameters, target))
    _check_wrappers(make, parameters, target)
    player = LevelPlayer(make, parameters, target, success)
    limit = make.limit(player)
    if not limit:
        raise ValueError("max_steps: missing: the environment has no time limit of its own")
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
    """Lets Gymnasium check the environment; what it cannot do with it is no reason to refuse it."""
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
    """Refuses a wrapper after which a level does not play alike twice, though it did before."""
    for count in range(len(make.wrappers) + 1 if make.wrappers else 0):
        some = replace(make, wrappers=make.wrappers[:count])
        player = LevelPlayer(some, parameters, play)
        first, second = (list(_played(player, SHORT)) for _ in range(2))
        player.close()
        if _same_episodes(first, second) and not hasattr(player.env, "update_running_mean"):
            continue
        if count:
            raise wrapper_error(
                make.wrappers[count - 1],
                "it keeps running statistics or the like, or draws numbers without the seed: the "
                "same actions on the same level can end otherwise the second time. What all "
                "environments share is normalised by PPO's normalize_observations and "
                "normalize_rewards",
            )
        return


def _check_episode(player: LevelPlayer, success: SuccessSettings, limit: int) -> None:
    """Plays one episode to its end, which must tell whether it was a success."""
    steps = list(_played(player, limit + 1))
    if success.kind == "survived" and steps[-1].truncated and player.in_time:
        warnings.warn(
            f"success.kind=survived: the environment cut an episode off after {len(steps)} steps, "
            f"before the time limit of {limit}, which is no survival; if that is its own time "
            "limit, set max_steps to it",
            stacklevel=2,
        )


def _check_values(player: LevelPlayer, name: str, plays: list[GymLevel]) -> None:
    """Sets a parameter to values, and checks that they arrive, stay, and change something.

    A change of the picture suffices, as it may take skill to meet what differs.
    """
    shown = player.observation_space, player.action_space
    episodes: list[list[_Played]] = []
    for play in plays:
        for seed in range(RESETS):
            player.play = play._replace(seed=play.seed + seed)
            player.reset()
            _refuse_strays(player, "after a reset")
        player.play = play
        episodes.append([])
        for step in _played(player, SHORT):
            if len(episodes[-1]) == 1:
                _refuse_strays(player, "after a step")
            episodes[-1].append(step)
        now = player.observation_space, player.action_space
        if now != shown:
            raise ValueError(
                f"parameters.{name}: all levels must show and take the same, but "
                f"{value_text(play.values[name])} changes {shown} to {now}"
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
    camera = Camera(player.make, player.parameters, ends[0])
    first, last = (camera.picture(play, None) for play in ends)
    return not camera.works or np.array_equal(first, last)


def _refuse_strays(player: LevelPlayer, when: str) -> None:
    if (line := player.mismatches()) is not None:
        raise ValueError(
            f"{line}, {when}: the environment sets it by itself; set it in another way, such as "
            "set: option or set: call"
        )


class _Played(NamedTuple):
    seen: Any
    reward: float
    terminated: bool
    truncated: bool


def _played(player: LevelPlayer, steps: int) -> Iterator[_Played]:
    """Yields the steps of an episode of random actions, the same ones every time."""
    numbers = np.random.default_rng(0)
    player.action_space.seed(0)
    player.reset()
    for _ in range(steps):
        parts = (_drawn(part, numbers) for _, part in leaves(player.action_space))
        action = assembled(player.action_space, parts)
        seen, reward, terminated, truncated, _ = player.step(action)
        yield _Played([np.array(part) for _, part in leaves(seen)], reward, terminated, truncated)
        if terminated or truncated:
            return


def _drawn(part: Any, numbers: np.random.Generator) -> Any:
    """Returns an action as a new policy draws it, which for a box is a normal one."""
    if not isinstance(part, spaces.Box):
        return part.sample()
    taken = PartTaken(part)
    return taken(torch.from_numpy(numbers.normal(size=taken.size))).numpy()


def _same_episodes(one: list[_Played], other: list[_Played]) -> bool:
    return len(one) == len(other) and all(
        a[1:] == b[1:] and all(map(np.array_equal, a.seen, b.seen))
        for a, b in zip(one, other, strict=True)
    )

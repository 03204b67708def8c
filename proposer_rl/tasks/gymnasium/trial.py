"""A trial before anything is trained: spaces, levels, rewards and successes of an environment."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils.passive_env_checker import check_action_space, check_observation_space

from proposer_rl.task import named
from proposer_rl.tasks.gymnasium.answers import (
    ROUNDING,
    SuccessSettings,
    UnfitEnvironmentError,
    check_seen,
)
from proposer_rl.tasks.gymnasium.attributes import read_attribute
from proposer_rl.tasks.gymnasium.pictures import Camera
from proposer_rl.tasks.gymnasium.player import (
    LevelPlayer,
    MakeEnvironment,
    ParameterSettings,
    Play,
    RefusedLevelError,
    WrapperError,
    cause,
    imported,
    wrapper_error,
    wrapper_of,
)
from proposer_rl.tasks.gymnasium.spaces import leaves
from proposer_rl.tasks.parameters import Bins

WHOLE_IN_FLOAT32 = 2**24  # up to which float32 has all whole numbers
SHORT = 64  # steps of an episode in which levels are compared
RESETS = 3  # after which a level must still be there


def tried(
    make: MakeEnvironment,
    parameters: Mapping[str, ParameterSettings],
    bins: Mapping[str, Bins],
    target: Play,
    success: SuccessSettings,
) -> int:
    """Plays an episode on a level of the target, and short ones at both ends of each parameter.

    At the ends of a parameter's bins all others are as in the target. Where its values stand for
    something else, each is tried.

    Returns:
        Steps of an episode at most.

    Raises:
        ValueError: in a line that names the key, for what cannot be imported, made, set or read, or
            is not as the environment's spaces and Gymnasium's interface say.
        ImportError, gymnasium.error.Error: of the environment, if it cannot be made.
    """
    _check_module(make.env_id)
    _check_places(parameters)
    _check_functions(make, parameters)
    _check_wrappers(make, parameters, target)
    # Gymnasium's own checker sees the beginning of an episode; it warns for the most part.
    watched = replace(make, wrappers=[], as_it_is=True, check=True)
    list(_played(LevelPlayer(watched, parameters, target), 1))
    player = LevelPlayer(make, parameters, target, success)
    limit = make.limit(player)
    if not limit:
        raise ValueError("max_steps: missing: the environment has no time limit of its own")
    _check_kinds(player, bins)
    _check_episode(player, success, limit)
    for name, part in bins.items():
        some = part.ends if parameters[name].to is None else part.low.tolist()
        plays = [target._replace(values={**target.values, name: one}) for one in some]
        _check_values(player, name, plays)
    player.close()
    return limit


def _check_module(env_id: str) -> None:
    module, colon, _ = env_id.partition(":")
    try:
        if colon:
            import_module(module)
    except ImportError:
        raise
    except Exception as error:  # whatever somebody's module may raise
        raise UnfitEnvironmentError(f"its module cannot be imported: {cause(error)}") from error


def _check_places(parameters: Mapping[str, ParameterSettings]) -> None:
    """Refuses two parameters of which one would undo the other."""
    taken: dict[tuple[str, str], str] = {}
    for name, given in parameters.items():
        for path in given.names(name):
            other = taken.setdefault((given.set, path), name)
            if other != name:
                raise ValueError(f"parameters.{name}: {path} is set by parameters.{other}, too")


def _check_functions(make: MakeEnvironment, parameters: Mapping[str, ParameterSettings]) -> None:
    for wrapper in make.wrappers:
        named("wrappers", wrapper_of, wrapper)
    for name, given in parameters.items():
        if given.set != "call":
            continue
        if given.name is None:
            raise ValueError(f"parameters.{name}.name: missing: which function, as module.name")
        for path in given.names(name):
            named(f"parameters.{name}.name", imported, path)


def _check_wrappers(
    make: MakeEnvironment, parameters: Mapping[str, ParameterSettings], play: Play
) -> None:
    """Plays an episode twice, without wrappers and after each of them has been put around."""
    for count in range(len(make.wrappers) + 1):
        some = replace(make, wrappers=make.wrappers[:count], as_it_is=True)
        try:
            player = LevelPlayer(some, parameters, play)
            check_observation_space(player.observation_space)
            check_action_space(player.action_space)
            if count == len(make.wrappers):
                _warn_of_misleading(player.observation_space)
            first, second = (list(_played(player, SHORT)) for _ in range(2))
            player.close()
        except (ImportError, gymnasium.error.Error, WrapperError):
            raise
        except Exception as error:  # whatever an environment of somebody's may raise
            if count:
                raise wrapper_error(make.wrappers[count - 1], error) from error
            if isinstance(error, RefusedLevelError | UnfitEnvironmentError):
                raise
            raise UnfitEnvironmentError(f"it does not work: {cause(error)}") from error
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
        warnings.warn(
            f"{make.env_id}: the same actions on the same level end otherwise the second time: the "
            "reset's seed does not decide all of it. No two measurements are quite comparable",
            stacklevel=2,
        )
        return


def _check_episode(player: LevelPlayer, success: SuccessSettings, limit: int) -> None:
    """Plays one episode to its end, which must tell whether it was a success."""
    steps = list(_played(player, limit + 1))
    *_, last = steps
    early = last.truncated and player.in_time
    if success.kind == "survived" and early:
        warnings.warn(
            f"success.kind=survived: the environment cut an episode off after {len(steps)} steps, "
            f"before the time limit of {limit}, which is no survival; if that is its own time "
            "limit, set max_steps to it",
            stacklevel=2,
        )
    if success.least is not None:
        _check_reachable(player, success.least, [step.reward for step in steps], limit)


def _check_reachable(player: LevelPlayer, least: float, rewards: list[float], limit: int) -> None:
    """Refuses a return above what the environment says, warns of one above what it seems to pay."""
    match getattr(player.unwrapped, "reward_range", None):  # as in Gymnasium before 1
        case (_, int() | float() as highest):
            pass
        case _:
            highest = np.inf
    if max(rewards) <= highest and least > max(highest, highest * limit):
        raise ValueError(
            f"success.least={least:g}: is never reached: the environment's reward_range ends at "
            f"{highest:g}, and an episode after {limit} steps"
        )
    reward = rewards[0]
    most = reward * limit * (1 + ROUNDING)
    if reward > 0 and min(rewards) == max(rewards) and least > most:
        warnings.warn(
            f"success.least={least:g}: can it be reached? Each step of an episode had a reward of "
            f"{reward:g}, and there are {limit} steps at most",
            stacklevel=2,
        )


def _check_kinds(player: LevelPlayer, bins: Mapping[str, Bins]) -> None:
    """Warns of fractions in the place of whole numbers, before there has been a reset."""
    for name, given in player.parameters.items():
        if given.set != "attribute" or given.to or not bins[name].low.is_floating_point():
            continue
        for path in given.names(name):
            before = read_attribute(player.unwrapped, path)
            if isinstance(before, int) and not isinstance(before, bool):
                warnings.warn(
                    f"parameters.{name}: {path} is a whole number, {before}, and gets fractions; "
                    "where it counts something, give values: [...] of whole numbers",
                    stacklevel=2,
                )


def _check_values(player: LevelPlayer, name: str, plays: list[Play]) -> None:
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
                f"{play.values[name]:g} changes {shown} to {now}"
            )
    ends = plays[0], plays[-1]
    first, last = (play.values[name] for play in ends)
    same = first != last and _same_episodes(episodes[0], episodes[-1])
    if same and _look_alike(player, ends):
        warnings.warn(
            f"parameters.{name}: {len(episodes[0])} steps with {first:g} and with {last:g} are the "
            "same to the last digit: the environment may not read this parameter",
            stacklevel=2,
        )


def _look_alike(player: LevelPlayer, ends: Sequence[Play]) -> bool:
    camera = Camera(player.make, player.parameters, ends[0])
    first, last = (camera.picture(play, None) for play in ends)
    return not camera.works or np.array_equal(first, last)


def _refuse_strays(player: LevelPlayer, when: str) -> None:
    if (line := player.strays()) is not None:
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
    """Yields the checked steps of an episode of random actions, the same ones every time."""
    numbers = np.random.default_rng(0)
    player.action_space.seed(0)
    seen, _ = player.reset()
    check_seen(player.observation_space, seen, "reset")
    for _ in range(steps):
        seen, reward, terminated, truncated, _ = player.step(_action(player.action_space, numbers))
        check_seen(player.observation_space, seen, "step")
        yield _Played([np.array(part) for _, part in leaves(seen)], reward, terminated, truncated)
        if terminated or truncated:
            return


def _action(space: spaces.Space[Any], numbers: np.random.Generator) -> Any:
    """Returns an action as a new policy draws it, which for a box is a normal one."""
    if not isinstance(space, spaces.Box):
        return space.sample()
    drawn = numbers.normal(size=space.shape).clip(space.low, space.high)
    return drawn.astype(space.dtype)


def _warn_of_misleading(space: spaces.Space[Any]) -> None:
    """Warns of what a network gets otherwise than expected."""
    for name, part in leaves(space):
        if name.split(".")[-1] == "action_mask":
            warnings.warn(
                f"{name}: is shown to the Solver as numbers; actions are not masked", stacklevel=2
            )
        if isinstance(part, spaces.Box) and part.dtype.kind in "iu":
            largest = max(abs(int(part.low.min())), abs(int(part.high.max())))
            whole = np.iinfo(part.dtype)
            if WHOLE_IN_FLOAT32 < largest < max(-whole.min, whole.max):
                warnings.warn(
                    f"{name or 'observation'}: whole numbers up to {largest:,} lose digits beyond "
                    f"{WHOLE_IN_FLOAT32:,}, since a network gets them as float32",
                    stacklevel=2,
                )


def _same_episodes(one: list[_Played], other: list[_Played]) -> bool:
    return len(one) == len(other) and all(
        a[1:] == b[1:] and all(map(np.array_equal, a.seen, b.seen))
        for a, b in zip(one, other, strict=True)
    )

"""What an environment answers, read strictly: nothing stands for something that it is not."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

# Spaces whose values are one number or an array of them.
NUMERIC = spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary
LARGEST = float(np.finfo(np.float32).max)


class UnfitEnvironmentError(ValueError):
    """An environment does not do as Gymnasium's interface says; the message is one line."""

    exit_code = 2


class Answers(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment that is held to Gymnasium's interface.

    Rewards become floats, ends of episodes become truth values.
    """

    def reset(self, **given: Any) -> tuple[Any, dict[str, Any]]:
        """Reset; what comes back must be an observation and an info."""
        try:
            result = self.env.reset(**given)
        except TypeError as error:
            if "unexpected keyword argument" not in str(error):
                raise
            raise UnfitEnvironmentError(
                f"reset must take the arguments seed and options: {error} (as in old Gym?)"
            ) from error
        if not (isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], Mapping)):
            raise UnfitEnvironmentError(
                "reset must return two values, the observation and an info, which is a "
                f"dictionary; it returns {_what(result)} (as in old Gym?)"
            )
        return result

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One step; what comes back must be five values."""
        return stepped(self.env.step(action))


def stepped(result: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
    """What a step has returned: the reward as a finite float, the ends as truth values.

    Raises:
        UnfitEnvironmentError: if it is not that.
    """
    if not (isinstance(result, tuple) and len(result) == 5 and isinstance(result[4], Mapping)):
        raise UnfitEnvironmentError(
            "step must return five values, observation, reward, terminated, truncated and an "
            f"info, which is a dictionary; it returns {_what(result)} (as in old Gym?)"
        )
    seen, reward, terminated, truncated, info = result
    over = flag(terminated, "terminated"), flag(truncated, "truncated")
    reward = number(reward, "the reward")
    if not abs(reward) <= LARGEST:
        raise UnfitEnvironmentError(
            f"step pays a reward of {reward}: it must be finite, also as float32"
        )
    return seen, reward, *over, info


def number(value: Any, what: str) -> float:
    """A number, or the only element of an array, as a float.

    Raises:
        UnfitEnvironmentError: if it is none.
    """
    if type(value) is float:
        return value
    element = _element(value)
    if isinstance(element, int | float):
        return float(element)
    raise UnfitEnvironmentError(
        f"{what} must be a number, not {_what(value)}; an array of one number is one, too"
    )


def flag(value: Any, what: str) -> bool:
    """A truth value, 0 or 1, or the only element of an array, as a bool.

    Raises:
        UnfitEnvironmentError: if it is none.
    """
    if type(value) is bool:
        return value
    element = _element(value)
    if isinstance(element, int | float) and element in (0, 1):
        return bool(element)
    raise UnfitEnvironmentError(f"{what} must be true or false, not {_what(value)}")


def entries(info: Mapping[str, Any], within: str = "") -> Iterator[tuple[str, Any]]:
    """An info's entries by their names, also those within others: ``metrics.won``."""
    for name, value in info.items():
        yield f"{within}{name}", value
        if isinstance(value, Mapping):
            yield from entries(value, f"{within}{name}.")


def check_seen(space: spaces.Space[Any], seen: Any, by: str) -> None:
    """Refuse an observation that would be read as another than it is.

    A number beyond its bounds is not: nothing here depends on them.

    Raises:
        UnfitEnvironmentError: saying by what it was shown, what it is, and the space.
    """
    line = _unlike(space, seen)
    if line is not None:
        raise UnfitEnvironmentError(f"{by} shows {line}; its observation space is {space}")


def _unlike(space: spaces.Space[Any], seen: Any) -> str | None:
    if isinstance(space, spaces.Dict):
        if not isinstance(seen, Mapping) or seen.keys() != space.spaces.keys():
            return f"{_short(seen)} instead of the entries {', '.join(space.spaces)}"
        return next(filter(None, (_unlike(s, seen[k]) for k, s in space.spaces.items())), None)
    if isinstance(space, spaces.Tuple):
        if not isinstance(seen, tuple) or len(seen) != len(space.spaces):
            return f"{_short(seen)} instead of a tuple of {len(space.spaces)}"
        parts = zip(space.spaces, seen, strict=True)
        return next(filter(None, (_unlike(s, one) for s, one in parts)), None)
    if not isinstance(space, NUMERIC):
        return None if space.contains(seen) else _short(seen)
    try:
        array = np.asarray(seen)
    except ValueError:
        return _short(seen)
    if array.shape != space.shape:
        return f"an observation of shape {list(array.shape)} instead of {list(space.shape or ())}"
    if array.dtype.kind not in "biuf":
        return f"{_short(seen)}, which are no numbers"
    with np.errstate(over="ignore"):
        if not np.isfinite(array.astype(np.float32)).all():
            return "NaN or infinity, or a number beyond float32"
    if not np.array_equal(array.astype(space.dtype), array) and space.dtype.kind in "biu":
        return f"{_short(array)} of {array.dtype}, which {space.dtype} cannot hold"
    if isinstance(space, spaces.Box):
        return None
    one = array.item() if isinstance(space, spaces.Discrete) else array.astype(space.dtype)
    return None if space.contains(one) else _short(seen)


def _short(seen: Any) -> str:
    text = " ".join(str(seen).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


def _element(value: Any) -> Any:
    """The only element of an array or a list as a number of Python's; anything else as it is."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError):
        return value
    return array.item() if array.size == 1 else value


def _what(value: Any) -> str:
    if isinstance(value, tuple):
        return f"a tuple of {len(value)}: {', '.join(type(one).__name__ for one in value)}"
    return f"{_short(repr(value))} ({type(value).__name__})"

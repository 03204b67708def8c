"""What an environment answers, read strictly: nothing stands for something that it is not."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np


class UnfitEnvironmentError(ValueError):
    """An environment does not do as Gymnasium's interface says; the message is one line."""

    exit_code = 2


class Answers(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment that is held to Gymnasium's interface, and its steps are counted.

    Rewards become floats, ends of episodes become truth values.

    Args:
        env: the environment.
        limit: steps of an episode; None for any number.

    Attributes:
        in_time: whether the limit has not been reached.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], limit: int | None) -> None:
        super().__init__(env)
        self._limit, self._steps, self.in_time = limit, 0, True

    def reset(self, **given: Any) -> tuple[Any, dict[str, Any]]:
        """Reset; what comes back must be an observation and an info."""
        self._steps, self.in_time = 0, True
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
        result = self.env.step(action)
        if not (isinstance(result, tuple) and len(result) == 5 and isinstance(result[4], Mapping)):
            raise UnfitEnvironmentError(
                "step must return five values, observation, reward, terminated, truncated and an "
                f"info, which is a dictionary; it returns {_what(result)} (as in old Gym?)"
            )
        seen, reward, terminated, truncated, info = result
        self._steps += 1
        self.in_time = self._limit is None or self._steps < self._limit
        over = flag(terminated, "terminated"), flag(truncated, "truncated")
        return seen, number(reward, "the reward"), *over, info


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
    raise UnfitEnvironmentError(f"{what} must be a number, not {_what(value)}")


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
    text = " ".join(repr(value).split())
    return f"{text if len(text) <= 60 else text[:57] + '...'} ({type(value).__name__})"

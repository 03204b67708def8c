"""What an environment answers, read strictly: nothing stands for something that it is not."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, Literal, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces

from proposer_rl.settings import settings
from proposer_rl.tasks.parameters import LARGEST

ROUNDING = 1e-6  # of a sum of rewards, as a share of it: ten times 0.1 is 0.9999999999999999
# Spaces whose values are one number or an array of them.
NUMERIC = spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary


class UnfitEnvironmentError(ValueError):
    """An environment does not do as Gymnasium's interface says; the message is one line."""

    exit_code = 2


class Answers(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment that is held to Gymnasium's interface.

    Rewards become floats, ends of episodes become truth values.
    """

    def reset(self, **given: Any) -> tuple[Any, dict[str, Any]]:
        """Resets the environment, which must return an observation and an info."""
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
        """Takes a step, which must return five values."""
        return stepped(self.env.step(action))


def stepped(result: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
    """Returns what a step has returned, the reward as a finite float, the ends as truth values.

    Raises:
        UnfitEnvironmentError: if it is not that.
    """
    if not (isinstance(result, tuple) and len(result) == 5 and isinstance(result[4], Mapping)):
        raise UnfitEnvironmentError(
            "step must return five values, observation, reward, terminated, truncated and an "
            f"info, which is a dictionary; it returns {_what(result)} (as in old Gym?)"
        )
    seen, reward, terminated, truncated, info = result
    over = as_flag(terminated, "terminated"), as_flag(truncated, "truncated")
    reward = as_number(reward, "the reward")
    if not abs(reward) <= LARGEST:
        raise UnfitEnvironmentError(
            f"step pays a reward of {reward}: it must be finite, also as float32"
        )
    return seen, reward, *over, info


def as_number(value: Any, what: str) -> float:
    """Returns a number, or the only element of an array, as a float.

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


def as_flag(value: Any, what: str) -> bool:
    """Returns a truth value, 0 or 1, or the only element of an array, as a bool.

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
    """Yields an info's entries by their names, also those within others, as ``metrics.won``."""
    for name, value in info.items():
        yield f"{within}{name}", value
        if isinstance(value, Mapping):
            yield from entries(value, f"{within}{name}.")


class Step(NamedTuple):
    """A step, mostly the last one of an episode.

    Attributes:
        terminated: whether the environment ended it.
        truncated: whether it was cut off.
        in_time: whether the time limit had not been reached.
        returns: the sum of the episode's rewards.
        info: the environment's further entries.
    """

    terminated: bool
    truncated: bool
    in_time: bool
    returns: float
    info: Mapping[str, Any]


@settings
class SuccessSettings:
    """When an episode counts as a success; called with its last step, it says whether it does.

    Attributes:
        kind: ``return``: it has at least the return ``least``; ``survived``: the time limit ended
            it, and nothing else; ``terminated``: the environment did, before; ``info``: an entry of
            the last step's info is true.
        least: the return.
        key: the entry's name; dots lead to entries of entries.
        optional: whether the entry is there only where the episode is a success.
        once: whether the entry may be true in any step, so that what is reached and lost again is a
            success, too.
    """

    kind: Literal["return", "survived", "terminated", "info"]
    least: float | None = None
    key: str | None = None
    optional: bool = False
    once: bool = False

    def check(self) -> None:
        """Refuses a kind that lacks what it needs, or has more.

        Raises:
            ValueError: naming the key.
        """
        needed = {"return": "least", "info": "key"}.get(self.kind)
        for name in ("least", "key"):
            given = getattr(self, name) is not None
            if given != (name == needed):
                verb = "has no effect" if given else "missing"
                raise ValueError(f"success.{name}: {verb} with success.kind={self.kind}")
        for name in ("optional", "once"):
            if getattr(self, name) and self.kind != "info":
                raise ValueError(f"success.{name}: has no effect with success.kind={self.kind}")

    def __call__(self, step: Step) -> bool:
        """Returns whether an episode with this last step, or with ``once`` any such, is a success.

        Raises:
            UnfitEnvironmentError: if its info says it in something else than a truth value.
        """
        if self.kind == "return":
            least = self.least or 0.0
            return step.returns >= least or math.isclose(step.returns, least, rel_tol=ROUNDING)
        if self.kind == "survived":
            return not step.terminated and not step.in_time
        if self.kind == "terminated":
            return step.terminated
        value = self._entry(step.info)
        return value is not None and as_flag(
            value, f"success.key={self.key}: the entry of the info"
        )

    def check_info(self, info: Mapping[str, Any]) -> None:
        """Refuses the last info of an episode that does not say whether that was a success.

        Raises:
            UnfitEnvironmentError: naming the key and the entries that there are.
        """
        if self.kind == "info" and not self.optional and self._entry(info) is None:
            there = ", ".join(name for name, _ in entries(info))
            raise UnfitEnvironmentError(
                f"success.key={self.key}: the last info of an episode has no such entry; it has: "
                f"{there or 'none'}; where only episodes that succeed have it, set "
                "success.optional=true"
            )

    def _entry(self, info: Mapping[str, Any]) -> Any:
        """Returns the info's entry; None where it is absent."""
        return dict(entries(info)).get(self.key or "")


def check_seen(space: spaces.Space[Any], seen: Any, by: str) -> None:
    """Refuses an observation that would be read as another than it is.

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
    """Returns the only element of an array or a list as Python's own; anything else as it is."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError):
        return value
    return array.item() if array.size == 1 else value


def _what(value: Any) -> str:
    if isinstance(value, tuple):
        return f"a tuple of {len(value)}: {', '.join(type(one).__name__ for one in value)}"
    return f"{_short(repr(value))} ({type(value).__name__})"

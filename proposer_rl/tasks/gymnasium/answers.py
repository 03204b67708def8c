"""Checks what a step of an environment returns, and whether an episode is a success."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np

from proposer_rl.settings import ArgumentError, settings, shown

ROUNDING = 1e-6  # of a sum of rewards, as a share of it: ten times 0.1 is 0.9999999999999999


class UnfitEnvironmentError(ValueError):
    """An environment cannot be made, set or read as it should be; the message is one line."""

    exit_code = 2


def stepped(result: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
    """Returns what a step has returned, the reward as a float, the ends as truth values.

    Raises:
        UnfitEnvironmentError: if the reward is no number.
    """
    seen, reward, terminated, truncated, info = result
    return seen, as_number(reward, "the reward"), bool(terminated), bool(truncated), info


def as_number(value: Any, what: str) -> float:
    """Returns a number, or the only element of an array, as a float.

    Raises:
        UnfitEnvironmentError: if it is none.
    """
    if type(value) is float:
        return value
    try:
        element = np.asarray(value).item()
    except (TypeError, ValueError, RuntimeError):
        element = None
    if not isinstance(element, int | float):
        raise UnfitEnvironmentError(f"{what} must be a number, not {shown(value)}")
    return float(element)


def as_flag(value: Any, what: str) -> bool:
    """Returns a truth value, 0 or 1, or the only element of an array, as a bool.

    Raises:
        UnfitEnvironmentError: if it is none.
    """
    number = as_number(value, what)
    if number not in (0, 1):
        raise UnfitEnvironmentError(f"{what} must be true or false, not {shown(value)}")
    return bool(number)


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

    def __post_init__(self) -> None:
        needed = {"return": "least", "info": "key"}.get(self.kind)
        if needed and getattr(self, needed) is None:
            raise ArgumentError(f"{needed}: missing with kind={self.kind}")

    def __call__(self, step: Step) -> bool:
        """Returns whether an episode with this last step, or with ``once`` any such, is a success.

        Raises:
            UnfitEnvironmentError: if the info says it in something else than a truth value, or that
                of a last step does not say it, with the entries that there are.
        """
        if self.kind == "return":
            least = self.least or 0.0
            return step.returns >= least or math.isclose(step.returns, least, rel_tol=ROUNDING)
        if self.kind == "survived":
            return not step.terminated and not step.in_time
        if self.kind == "terminated":
            return step.terminated
        value = dict(entries(step.info)).get(self.key or "")
        if value is not None:
            return as_flag(value, f"success.key={self.key}: the entry of the info")
        if not self.optional and (step.terminated or step.truncated):
            there = ", ".join(name for name, _ in entries(step.info))
            raise UnfitEnvironmentError(
                f"success.key={self.key}: the last info of an episode has no such entry; it has: "
                f"{there or 'none'}; where only episodes that succeed have it, set "
                "success.optional=true"
            )
        return False

"""When an episode counts as a success."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from proposer_rl.tasks.gymnasium.settings import SuccessSettings

Flags = NDArray[np.bool_]


class Steps(NamedTuple):
    """A step of n environments: how it ended, and the returns of the episodes so far, each [n]."""

    terminated: Flags
    truncated: Flags
    returns: NDArray[np.float64]
    info: Mapping[str, Any]


Rule = Callable[[Steps], Flags]
"""Whether each step ended an episode that is a success."""


def success_rule(settings: SuccessSettings) -> Rule:
    """The rule of some settings.

    Raises:
        ValueError: if they lack what their kind needs, or have more.
    """
    needed = {"return": "least", "info": "key"}.get(settings.kind)
    for name in ("least", "key"):
        given = getattr(settings, name) is not None
        if given != (name == needed):
            verb = "has no effect" if given else "missing"
            raise ValueError(f"success.{name}: {verb} with success.kind={settings.kind}")
    least, key = settings.least or 0.0, settings.key or ""
    rules: dict[str, Rule] = {
        "return": lambda step: _over(step) & (step.returns >= least),
        "survived": lambda step: step.truncated & ~step.terminated,
        "terminated": lambda step: step.terminated,
        "info": lambda step: _over(step) & _told(step, key),
    }
    return rules[settings.kind]


def _over(step: Steps) -> Flags:
    return step.terminated | step.truncated


def _told(step: Steps, key: str) -> Flags:
    """An entry of the infos, false where an environment has none."""
    none = np.zeros(len(step.returns), np.bool_)
    return np.asarray(step.info.get(key, none)).astype(np.bool_)

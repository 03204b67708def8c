"""Sets the parameters of Gymnasium's CartPole that are no plain attributes."""

from __future__ import annotations

from typing import Any


def set_length(environment: Any, length: float) -> None:
    """Sets half the pole's length, in metres, and what CartPole computes from it once.

    Args:
        environment: ``CartPole-v1`` without wrappers.
        length: half of the pole's.
    """
    environment.length = length
    environment.polemass_length = environment.masspole * length

"""Sets parameters of Gymnasium's CartPole from which it computes others."""

from __future__ import annotations

from typing import Any


def set_length(environment: Any, length: float) -> None:
    """Sets half the pole's length, and the product with its mass that CartPole keeps.

    Args:
        environment: ``CartPole-v1`` without wrappers.
        length: half of the pole's, in metres.
    """
    environment.length = length
    environment.polemass_length = environment.masspole * length

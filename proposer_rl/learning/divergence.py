"""The check that an update's numbers are finite, and the error that names one that is not."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn


class DivergedError(ArithmeticError):
    """A number is not finite; the message is one line that says which, and in which replica."""

    exit_code = 3


def require_finite(
    reward: Tensor,
    steps: TensorDictBase,
    weights: Mapping[str, Tensor],
    copies: int | None,
    first: int = 0,
) -> None:
    """Checks one update; costs one number read from the device unless something is wrong.

    Args:
        reward: of the rollout, [B, ...], B the first dimension of the environment.
        steps: of S gradient steps, [S], the losses ``loss_...`` and the ``grad_norm`` of each
            replica, [S, K], or without replicas [S].
        weights: after the update, by name, [K, ...] with replicas.
        copies: K, or None for a single network.
        first: number of the first replica, by which replicas are named.

    Raises:
        DivergedError: naming what was not finite first, and the replicas that it happened in. The
            others are as they would be without it: nothing is shared between replicas.
    """
    # What a gradient step leaves behind, in the order in which it arises.
    names = [*(key for key in steps.keys() if key.startswith("loss_")), "grad_norm"]
    scalars = [steps[name] for name in names]
    # A sum of magnitudes is finite only if all of them are.
    sums = nn.utils.get_total_norm([reward, *scalars, *weights.values()], norm_type=1.0)
    if bool(sums.isfinite()):
        return
    _require_finite("reward", reward, len(reward), first)
    for i in range(len(steps)):
        for name in names:
            _require_finite(f"{name} of gradient step {i}", steps[name][i], copies, first)
    for name, weight in weights.items():
        _require_finite(f"weight {name}", weight, copies, first)


@contextmanager
def located(place: str) -> Iterator[None]:
    """Says in a :class:`DivergedError` from inside where in the run that was."""
    try:
        yield
    except DivergedError as error:
        raise DivergedError(f"{place}: {error}") from error


def _require_finite(name: str, tensor: Tensor, copies: int | None, first: int) -> None:
    finite = tensor.detach().isfinite().reshape(copies or 1, -1)
    if bool(finite.all()):
        return
    worst = float(tensor.detach().reshape(-1)[~finite.reshape(-1)][0])
    which = (first + torch.nonzero(~finite.all(1)).flatten()).tolist()
    named = "" if copies is None else f"copy {', '.join(map(str, which))}: "
    raise DivergedError(f"{named}{name} is not finite ({worst})")

"""Torch's global state: the library computes in its own, and whoever calls it keeps theirs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass
from typing import NamedTuple

import torch


class _State(NamedTuple):
    """Torch's defaults that results depend on."""

    dtype: torch.dtype
    gradients: bool
    inference: bool
    device: torch.device


OWN = _State(torch.float32, True, False, torch.device("cpu"))


@dataclass
class _Callers:
    """The callers' state while the library computes, and whether `with torch.device` is in it."""

    state: _State
    within: bool = False


_CALLERS: ContextVar[_Callers | None] = ContextVar("_CALLERS", default=None)


def _now() -> _State:
    return _State(
        torch.get_default_dtype(),
        torch.is_grad_enabled(),
        torch.is_inference_mode_enabled(),
        torch.empty(0).device,  # told sooner than by torch.get_default_device()
    )


@contextmanager
def own_state() -> Iterator[None]:
    """Sets float32, gradients and the CPU as torch's defaults inside, the caller's afterwards.

    Afterwards torch is as the caller has set it, or a module of theirs that was imported meanwhile.
    The default precision is the whole process's: threads beside this one see float32 meanwhile.

    Example:
        >>> torch.set_default_dtype(torch.float64)
        >>> with own_state():
        ...     torch.ones(1).dtype
        torch.float32
        >>> torch.ones(1).dtype, torch.set_default_dtype(torch.float32)
        (torch.float64, None)
    """
    before, outer = _now(), _CALLERS.get()
    callers = outer or _Callers(before)
    token = _CALLERS.set(callers)
    try:
        _set(before._replace(device=OWN.device))
        callers.within = callers.within or torch.empty(0).device != OWN.device
        with _entered(OWN, callers.within):
            yield
    finally:
        _CALLERS.reset(token)
        _set(before if outer else callers.state)


@contextmanager
def callers_state() -> Iterator[None]:
    """Restores the caller's torch defaults inside of :func:`own_state`.

    What that changes there is theirs the next time, too. Elsewhere nothing is changed.
    """
    callers = _CALLERS.get()
    if callers is None:
        yield
        return
    before = _now()
    try:
        with _entered(callers.state, callers.within):
            try:
                yield
            finally:
                callers.state = _now()
    finally:
        _set(before)


@contextmanager
def _entered(state: _State, within: bool) -> Iterator[None]:
    """Torch in a state; afterwards gradients, inference mode and a device within are as before."""
    with torch.inference_mode(state.inference), state.device if within else nullcontext():
        _set(state)
        yield


def _set(state: _State) -> None:
    torch.set_grad_enabled(state.gradients)
    torch.set_default_dtype(state.dtype)
    if torch.empty(0).device != state.device:
        torch.set_default_device(None if state.device == OWN.device else state.device)

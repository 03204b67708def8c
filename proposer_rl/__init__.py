"""proposer_rl: learn to propose the problems that make a TorchRL agent improve fastest.

Its names are those of :mod:`proposer_rl.api`, which is imported when the first of them is used:
what only reads runs needs no PyTorch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from proposer_rl.api import *  # noqa: F403


def __getattr__(name: str) -> Any:
    if name.startswith("__") and name != "__all__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("proposer_rl.api"), name)

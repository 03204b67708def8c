"""proposer_rl: automatic curricula for reinforcement learning in PyTorch and TorchRL.

``train`` trains on a task with a curriculum; ``tasks`` and ``curricula`` have both, by name; the
other names are what one's own loop is composed of. They are those of :mod:`proposer_rl.api`, which
is imported when the first of them is used: what only reads runs needs no PyTorch.

Example:
    >>> import proposer_rl as prl
    >>> task, curriculum = prl.tasks.maze(), prl.curricula.plr(temperature=0.5)
    >>> run = prl.train(task, curriculum, scale="smoke", folder="my_run")  # doctest: +SKIP
    >>> run.metrics[["updates", "id_success"]]  # doctest: +SKIP
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from proposer_rl.api import *  # noqa: F403


def __getattr__(name: str) -> Any:
    if name == "__all__":
        return __dir__()
    if name.startswith("__"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("proposer_rl.api"), name)


def __dir__() -> list[str]:
    return [name for name in vars(import_module("proposer_rl.api")) if not name.startswith("_")]

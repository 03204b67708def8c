"""The environments that come along, each in a folder that nothing else knows.

``tasks.maze()``, ``tasks.cartpole()`` and so on are recipes, named as the files of ``conf/task``
and with their settings, for :func:`proposer_rl.train`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from proposer_rl.recipes import Recipe, available, own_recipe, recipe_function

OF_GYMNASIUM = "gymnasium"  # the file of any environment of Gymnasium; a folder here has its name


def from_gymnasium(env_id: str, **settings: Any) -> Recipe:
    """Returns a task of any environment of Gymnasium, some of whose settings make a level.

    Args:
        env_id: such as ``"CartPole-v1"``; ``"module:name"`` imports the module first.
        settings: those of ``conf/task/gymnasium.yaml``: ``parameters``, ``success``, ``max_steps``
            and the others.

    Raises:
        ArgumentError: for a setting that there is not, with those that there are.
    """
    return recipe_function("task", OF_GYMNASIUM)(env_id=env_id, **settings)


def own(make: Callable[..., Any], **settings: Any) -> Recipe:
    """Returns a task of one's own: see :func:`proposer_rl.recipes.own_recipe`."""
    return own_recipe("task", make, **settings)


def __getattr__(name: str) -> Callable[..., Recipe]:
    return recipe_function("task", name)


def __dir__() -> list[str]:
    return ["from_gymnasium", "own", *(name for name in available("task") if name != OF_GYMNASIUM)]

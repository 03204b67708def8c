"""Environments that come with the package, as recipes for :func:`proposer_rl.train`.

``tasks.maze()``, ``tasks.cartpole()`` and so on are named as the files of ``conf/task``, and take
their settings. Nothing outside of an environment's own folder knows it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from proposer_rl.recipes import Recipe, available, own_recipe, recipe_function

OF_GYMNASIUM = "gymnasium"  # the file of any Gymnasium environment, named as a folder here


def from_gymnasium(env_id: str, **settings: Any) -> Recipe:
    """Returns a task of any Gymnasium environment, in which some settings make a level.

    Args:
        env_id: such as ``"CartPole-v1"``; ``"module:name"`` imports the module first.
        settings: those of ``conf/task/gymnasium.yaml``: ``parameters``, ``success``, ``max_steps``
            and the others.

    Raises:
        ArgumentError: for an unknown setting, listing the known ones.
    """
    return recipe_function("task", OF_GYMNASIUM)(env_id=env_id, **settings)


def own(make: Callable[..., Any], **settings: Any) -> Recipe:
    """Returns a task of your own; see :func:`proposer_rl.recipes.own_recipe`."""
    return own_recipe("task", make, **settings)


def __getattr__(name: str) -> Callable[..., Recipe]:
    return recipe_function("task", name)


def __dir__() -> list[str]:
    return ["from_gymnasium", "own", *(name for name in available("task") if name != OF_GYMNASIUM)]

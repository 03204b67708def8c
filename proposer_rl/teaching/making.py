"""Makes a teacher's curriculum, and adapts the functions that it may call."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from proposer_rl.curricula import Curriculum, LearnedCurriculum
from proposer_rl.curricula.batches import moved
from proposer_rl.meta.assembly import Components, ProposerSettings
from proposer_rl.methods import around, asked, build, completed
from proposer_rl.recipes import Recipe, as_recipe
from proposer_rl.settings import ArgumentError, plain
from proposer_rl.teaching.identity import of_classes

OF_LEVELS = ("optimal_return", "exact_performance", "performance", "play")


def make_curriculum(
    curriculum: Recipe | Curriculum | type[Curriculum] | str,
    space: Any,
    filter: Mapping[str, Any] | str | None,
    seed: int,
) -> tuple[Curriculum, dict[str, Any]]:
    """Makes a curriculum on the levels of a space or task, with its filter.

    Returns:
        The curriculum; and its name or class with all its settings, for JSON.

    Raises:
        ArgumentError: if the curriculum trains replicas of the learner.
    """
    run = Components(space, ProposerSettings(), seed)
    if isinstance(curriculum, type):
        curriculum = curriculum.create(run)
    if isinstance(curriculum, Curriculum):
        named, config = of_classes(curriculum), completed(asked(None, filter))
        made = around(curriculum, config, run)
    else:
        recipe = as_recipe("curriculum", "method", curriculum)
        named, config = recipe.name, completed(asked(recipe, filter))
        made = build(config, run)
    if isinstance(made, LearnedCurriculum) and made.trains_replicas:
        raise ArgumentError(
            f"curriculum={type(made).__name__}: trains replicas of the learner; use "
            "proposer_rl.train, or SolverTrainingEnv with your own learner"
        )
    own = config.pop("curriculum", {})
    own.pop("_target_", None)
    described = json.dumps(plain({"kind": named, **own, **config}), default=_name)
    return made, json.loads(described)


def adapted(name: str, function: Any, given: Callable[[Any], Any], device: torch.device) -> Any:
    """Wraps a loop's function of levels [n], so that it gets levels as the loop does.

    Args:
        name: the function's name in :class:`~proposer_rl.curricula.Student`.
        function: the loop's function.
        given: converts levels for the loop.
        device: the device on which the loop gets levels.
    """
    if name not in OF_LEVELS:
        return function

    def of_levels(levels: Any, *more: Any) -> Any:
        draws = more if name == "play" else ()
        found = function(given(moved(levels, device).clone()), *draws)  # it may change the copy
        if isinstance(found, dict):
            entries = {key: torch.as_tensor(entry).float() for key, entry in found.items()}
            return TensorDict(entries, levels.shape[:1])
        return found if isinstance(found, TensorDictBase) else torch.as_tensor(found)

    return of_levels


def _name(value: Any) -> str:
    return getattr(value, "__qualname__", type(value).__qualname__)

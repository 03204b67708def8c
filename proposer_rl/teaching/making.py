"""A curriculum by name for a space of levels, without a run and without Hydra."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pkgutil import resolve_name
from typing import Any

from proposer_rl.curricula import Curriculum, LearnedCurriculum
from proposer_rl.meta.assembly import ProposerSettings
from proposer_rl.methods import Components, UnfitTaskError, around, make, recipe_settings
from proposer_rl.recipes import (
    Recipe,
    as_recipe,
    filter_content,
    merged,
    resolved,
)
from proposer_rl.settings import ArgumentError, plain, shown
from proposer_rl.teaching.identity import of_classes


def make_curriculum(
    curriculum: Recipe | Curriculum | str,
    space: Any,
    filter: Mapping[str, Any] | str | None,
    seeds: Sequence[int],
) -> tuple[Curriculum, dict[str, Any]]:
    """Returns the curriculum on the levels of a space or task; by name, with its file's filter.

    Returns:
        The curriculum; its name or class and all settings that were said of it, for JSON.
    """
    if isinstance(space, type) or not hasattr(space, "space"):
        raise ArgumentError(
            f"space={shown(space)}: must be Parameters, Items, LevelGenerator, MadeLevels or a task"
        )
    run = Components(space, ProposerSettings(), seeds)
    asked: dict[str, Any] = {}
    if isinstance(curriculum, Curriculum):
        made, named, own = curriculum, of_classes(curriculum), {}
    else:
        recipe = as_recipe("curriculum", "method", curriculum)
        named, asked = recipe.name, recipe_settings(recipe)
        own = resolved(asked.pop("curriculum"))
        try:
            made = make(resolve_name(own.pop("_target_")), own, run)
        except UnfitTaskError as error:
            raise ArgumentError(f"curriculum={named}: {error}; give a task in its place") from error
    if isinstance(made, LearnedCurriculum) and made.trains_replicas:
        raise ArgumentError(
            f"curriculum={type(made).__name__}: trains replicas of the learner; use "
            "proposer_rl.train, or SolverTrainingEnv for learners of your own"
        )
    if filter is not None:
        asked = merged(asked, filter_content(filter))
    more = {key: asked[key] for key in ("filter", "model") if asked.get(key) is not None}
    described = json.dumps(plain({"kind": named, **own, **more}), default=_name)
    return around(made, more, run), json.loads(described)


def _name(value: Any) -> str:
    return getattr(value, "__qualname__", type(value).__qualname__)

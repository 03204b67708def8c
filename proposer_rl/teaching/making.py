"""A curriculum by name for a space of levels, without a run and without Hydra."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pkgutil import resolve_name
from typing import Any

from proposer_rl.curricula import Curriculum, LearnedCurriculum
from proposer_rl.meta.assembly import ProposerSettings
from proposer_rl.methods import Components, UnfitTaskError, filtered, make, modelled
from proposer_rl.recipes import (
    Recipe,
    file_content,
    filter_content,
    merged,
    recipe_function,
    resolved,
)
from proposer_rl.settings import ArgumentError, plain
from proposer_rl.teaching.identity import of_classes


def make_curriculum(
    curriculum: Recipe | Curriculum | str,
    space: Any,
    filter: Mapping[str, Any] | str | None,
    seeds: Sequence[int],
) -> tuple[Curriculum, dict[str, Any]]:
    """The curriculum on the levels of a space or task; by name with the filter of its file.

    Returns:
        The curriculum; its name or class and all settings that were said of it, for JSON.
    """
    run = Components(space, ProposerSettings(), seeds)
    asked: dict[str, Any] = {}
    if isinstance(curriculum, str):
        curriculum = recipe_function("method", curriculum)()
    if isinstance(curriculum, Recipe):
        named, asked = curriculum.name, _settings(curriculum)
        own = asked.pop("curriculum")
        try:
            made: Curriculum = make(resolve_name(own.pop("_target_")), own, run)
        except UnfitTaskError as error:
            raise ArgumentError(f"curriculum={named}: {error}; give a task in its place") from error
    else:
        made, named, own = curriculum, of_classes(curriculum), {}
    if isinstance(made, LearnedCurriculum) and made.trains_replicas:
        raise ArgumentError(
            f"curriculum={type(made).__name__}: trains replicas of the learner; use "
            "proposer_rl.train, or SolverTrainingEnv for learners of your own"
        )
    if filter is not None:
        asked = merged(asked, filter_content(filter))
    around = {key: asked[key] for key in ("filter", "model") if asked.get(key) is not None}
    if "filter" in around:
        made = filtered(made, around["filter"], run)
    if "model" in around:
        made = modelled(made, around["model"], run)
    described = json.dumps(plain({"kind": named, **own, **around}), default=_name)
    return made, json.loads(described)


def _settings(recipe: Recipe) -> dict[str, Any]:
    """The settings of a recipe by key, over those of its file."""
    if recipe.target:
        return {"curriculum": {**recipe.settings, "_target_": recipe.target}}
    file = file_content(f"method/{recipe.name}")
    # What a file makes of a class of its own is the default of the function, too.
    named = file["curriculum"].items()
    there = {name: value for name, value in named if not isinstance(value, Mapping)}
    return merged({**file, "curriculum": resolved(there)}, recipe.by_key())


def _name(value: Any) -> str:
    return getattr(value, "__qualname__", type(value).__qualname__)

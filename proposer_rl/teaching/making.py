"""A curriculum by name for a space of levels, without a run and without Hydra."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from pkgutil import resolve_name
from typing import Any

from proposer_rl.curricula import Curriculum, LearnedCurriculum
from proposer_rl.meta.assembly import ProposerSettings
from proposer_rl.methods import Components, filtered, modelled
from proposer_rl.recipes import Recipe, file_content, filter_content, recipe_function, yaml_file
from proposer_rl.settings import ArgumentError, arguments
from proposer_rl.teaching.identity import of_classes, plain

REFERENCE = re.compile(r"\$\{([\w.]+)\}")  # to another setting, as the files have them
AROUND = ("filter", "model")  # what a curriculum is put into


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
    asked: dict[str, Any] = {}
    if isinstance(curriculum, str):
        curriculum = recipe_function("method", curriculum)()
    if isinstance(curriculum, Recipe):
        file = {} if curriculum.target else file_content(f"method/{curriculum.name}")
        asked = _merged({key: file[key] for key in AROUND if key in file}, curriculum.by_key())
        named, settings = curriculum.name, _settings(curriculum, file)
        curriculum = _made(curriculum, file, settings, space, seeds)
    else:
        named, settings = of_classes(curriculum), {}
    if isinstance(curriculum, LearnedCurriculum) and curriculum.trains_replicas:
        raise ArgumentError(
            f"curriculum={type(curriculum).__name__}: trains replicas of the learner; use "
            "proposer_rl.train, or SolverTrainingEnv for learners of your own"
        )
    if filter is not None:
        asked = _merged(asked, filter_content(filter))
    around = {key: asked[key] for key in AROUND if asked.get(key) is not None}
    if "filter" in around:
        curriculum = filtered(curriculum, **around["filter"])
    if "model" in around:
        curriculum = modelled(curriculum, space, **around["model"])
    return curriculum, plain({"kind": named, **settings, **around})


def _settings(recipe: Recipe, file: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a curriculum itself: its file's, and over them the recipe's."""
    # What a file makes of a class of its own is the default of the function, too.
    named = file.get("curriculum", {}).items()
    there = {name: value for name, value in named if not isinstance(value, Mapping)}
    there.pop("_target_", None)
    train = yaml_file("train")
    own = recipe.by_key().get("curriculum", {})
    return {**{name: _resolved(value, train) for name, value in there.items()}, **own}


def _made(
    recipe: Recipe,
    file: Mapping[str, Any],
    settings: Mapping[str, Any],
    space: Any,
    seeds: Sequence[int],
) -> Curriculum:
    make: Callable[..., Any] = resolve_name(recipe.target or file["curriculum"]["_target_"])
    read = arguments(make, settings, [*inspect.signature(make).parameters][:1])
    try:
        made: Curriculum = make(Components(space, ProposerSettings(), seeds), **read)
    except AttributeError as error:
        if error.obj is not space:
            raise
        raise ArgumentError(
            f"curriculum={recipe.name}: needs {error.name} of a task, which this space of levels "
            "has not; give a task in its place"
        ) from error
    return made


def _merged(settings: Mapping[str, Any], more: Mapping[str, Any]) -> dict[str, Any]:
    """Settings by key, those of the second over those of the first; None in place of all."""
    found = dict(settings)
    for key, own in more.items():
        found[key] = None if own is None else {**(found.get(key) or {}), **own}
    return found


def _resolved(value: Any, settings: Mapping[str, Any]) -> Any:
    """The value, or what it refers to."""
    reference = REFERENCE.fullmatch(value) if isinstance(value, str) else None
    if reference is None:
        return value
    return reduce(lambda place, name: place[name], reference[1].split("."), settings)

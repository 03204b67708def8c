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
from proposer_rl.recipes import Recipe, available, file_content, recipe_function, yaml_file
from proposer_rl.settings import ArgumentError, arguments

REFERENCE = re.compile(r"\$\{([\w.]+)\}")  # to another setting, as the files have them


def make_curriculum(
    curriculum: Recipe | Curriculum | str,
    space: Any,
    filter: Mapping[str, Any] | str | None,
    seeds: Sequence[int],
) -> Curriculum:
    """The curriculum on the levels of a space or task; by name with the filter of its file."""
    asked: Mapping[str, Any] = {}
    if isinstance(curriculum, str):
        curriculum = recipe_function("method", curriculum)()
    if isinstance(curriculum, Recipe):
        if curriculum.target is None:
            asked = file_content(f"method/{curriculum.name}")
        curriculum = _made(curriculum, asked.get("curriculum", {}), space, seeds)
    if isinstance(curriculum, LearnedCurriculum) and curriculum.trains_replicas:
        raise ArgumentError(
            f"curriculum={type(curriculum).__name__}: trains replicas of the learner; use "
            "proposer_rl.train, or SolverTrainingEnv for learners of your own"
        )
    if isinstance(filter, str):
        if filter not in available("filter"):
            raise ArgumentError(f"filter={filter!r}: must be one of {available('filter')}")
        asked = file_content(f"filter/{filter}")
    elif filter is not None:
        asked = {"filter": filter}
    if asked.get("filter") is not None:
        curriculum = filtered(curriculum, **asked["filter"])
    return modelled(curriculum, space, **asked["model"]) if "model" in asked else curriculum


def _made(recipe: Recipe, named: Mapping[str, Any], space: Any, seeds: Sequence[int]) -> Curriculum:
    """The curriculum, by its file's settings and the recipe's."""
    train = yaml_file("train")
    # What a file makes of a class of its own is the default of the function, too.
    plain = {name: value for name, value in named.items() if not isinstance(value, Mapping)}
    values = {name: _resolved(value, train) for name, value in plain.items()}
    make: Callable[..., Any] = resolve_name(values.pop("_target_", recipe.target))
    given = {**values, **recipe.settings}
    read = arguments(make, given, [*inspect.signature(make).parameters][:1])
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


def _resolved(value: Any, settings: Mapping[str, Any]) -> Any:
    """The value, or what it refers to."""
    reference = REFERENCE.fullmatch(value) if isinstance(value, str) else None
    if reference is None:
        return value
    return reduce(lambda place, name: place[name], reference[1].split("."), settings)

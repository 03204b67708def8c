"""A curriculum by name for a space of levels, without a run and without Hydra."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from importlib import import_module
from typing import Any

from proposer_rl.curricula import Curriculum, LearnedCurriculum
from proposer_rl.meta.settings import ProposerSettings
from proposer_rl.methods import Components, filtered, modelled
from proposer_rl.recipes import Recipe, available, file_settings, recipe_function, yaml_file
from proposer_rl.settings import ArgumentError, arguments

REFERENCE = re.compile(r"\$\{([\w.]+)\}")  # to another setting, as the files have them
MODEL = "/source/model@_global_"  # likewise, a filter's file
FILTER = re.compile(r"/filter/(\w+)@_global_")  # that a method's file asks for


def make_curriculum(
    curriculum: Recipe | Curriculum | str,
    space: Any,
    filter: Mapping[str, Any] | str | None,
    seeds: Sequence[int],
) -> Curriculum:
    """The curriculum on the levels of a space.

    Args:
        curriculum: a recipe, its name, or a curriculum.
        space: a :class:`~proposer_rl.teaching.spaces.LevelSpace` or a task.
        filter: as of :func:`proposer_rl.train`; a curriculum by name may have one by default.
        seeds: of the students.

    Raises:
        ArgumentError: naming the setting, or what the space lacks.
    """
    if isinstance(curriculum, str):
        curriculum = recipe_function("method", curriculum)()
    if isinstance(curriculum, Recipe):
        filter = _default_filter(curriculum) if filter is None else filter
        curriculum = _made(curriculum, space, seeds)
    if isinstance(curriculum, LearnedCurriculum) and curriculum.trains_replicas:
        raise ArgumentError(
            f"curriculum={type(curriculum).__name__}: trains replicas of the learner; use "
            "proposer_rl.train, or SolverTrainingEnv for learners of your own"
        )
    on_model = False
    if isinstance(filter, str):
        if filter not in available("filter"):
            raise ArgumentError(f"filter={filter!r}: must be one of {available('filter')}")
        on_model = MODEL in yaml_file(f"filter/{filter}").get("defaults", ())
        filter = file_settings("filter", filter) or None
    if filter is not None:
        curriculum = filtered(curriculum, **filter)
    return modelled(curriculum, space) if on_model else curriculum


def _made(recipe: Recipe, space: Any, seeds: Sequence[int]) -> Curriculum:
    """The curriculum, by its file's settings and the recipe's."""
    values: dict[str, Any] = {"_target_": recipe.target}
    if recipe.target is None:
        train = yaml_file("train")
        named = file_settings("method", recipe.name).items()
        # What a file makes of a class of its own is the default of the function, too.
        plain = {name: value for name, value in named if not isinstance(value, Mapping)}
        values = {name: _resolved(value, train) for name, value in plain.items()}
    module, _, function = values.pop("_target_").rpartition(".")
    make: Callable[..., Any] = getattr(import_module(module), function)
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


def _default_filter(recipe: Recipe) -> str | None:
    """The name of the filter that a method's file asks for."""
    if recipe.target is not None:
        return None
    defaults = yaml_file(f"method/{recipe.name}").get("defaults", ())
    names = (FILTER.fullmatch(default) for default in defaults)
    return next((name[1] for name in names if name), None)

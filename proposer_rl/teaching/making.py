"""Makes a teacher's curriculum, without a run."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from proposer_rl.curricula import Curriculum, LearnedCurriculum
from proposer_rl.meta.assembly import Components, ProposerSettings
from proposer_rl.methods import around, asked, build, completed
from proposer_rl.recipes import Recipe, as_recipe
from proposer_rl.settings import ArgumentError, plain, shown
from proposer_rl.teaching.identity import of_classes


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
        ArgumentError: if the space is none, or the curriculum trains replicas of the learner.
    """
    if not hasattr(space, "space"):
        raise ArgumentError(
            f"space={shown(space)}: must be Parameters, Items, LevelGenerator, MadeLevels or a task"
        )
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


def _name(value: Any) -> str:
    return getattr(value, "__qualname__", type(value).__qualname__)

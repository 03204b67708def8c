"""Recipes of tasks and curricula by name, which ``prl.tasks.maze()`` and so on return.

The names are those of the files in ``conf/task`` and ``conf/method``, which the command line also
reads. Hydra composes the files, and settings given in Python are merged into the result.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from inspect import Parameter, Signature
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING, Any, Literal

from proposer_rl.extras import where_to_look

if TYPE_CHECKING:
    from omegaconf import DictConfig

PACKAGE = Path(__file__).resolve().parent
# A wheel has the configuration inside of the package, a checkout beside it.
CONFIG_FOLDER = PACKAGE / "conf" if (PACKAGE / "conf").is_dir() else PACKAGE.parent / "conf"
DEFAULT_METHOD = "adaptive_mixture"
NO_TASK = "~task"  # an override of Hydra's: compose no file of a task
COMPOSING = RLock()  # Hydra keeps its state in globals of the process
Group = Literal["task", "method"]


@dataclass(frozen=True)
class Recipe:
    """Describes a task or a curriculum, which is made when a run begins.

    Attributes:
        group: ``"task"`` or ``"method"``.
        name: of a file in that folder of the configuration, or of a function of one's own.
        words: overrides from which Hydra composes it.
        settings: merged into what Hydra has composed, by top-level key.
    """

    group: Group
    name: str
    words: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)


def own_recipe(group: Group, make: Callable[..., Any], **settings: Any) -> Recipe:
    """Returns the recipe of a task or curriculum of one's own.

    Args:
        group: ``"task"``, or ``"method"`` for a curriculum.
        make: a class or function that can be imported. For a task it is called with the settings,
            ``solver`` and ``context``; for a curriculum see :func:`proposer_rl.methods.build`.
        settings: numbers, texts, lists and mappings.

    Raises:
        ArgumentError: if it cannot be imported by its name.
    """
    own = {"_target_": _dotted("make", make), **settings}
    if group == "method":
        return Recipe(group, make.__name__, (), {"method": make.__name__, "curriculum": own})
    # Most tasks call the distribution to be mastered so; a headline that is given overrides this.
    schedule = {"headline": "target_success"}
    return Recipe(group, make.__name__, (NO_TASK,), {"task": own, "schedule": schedule})


def storable(key: str, value: Any) -> Any:
    """Returns a value as JSON stores it, with functions replaced by their dotted names.

    Raises:
        ArgumentError: naming the key, for a function that cannot be imported by its name, and for a
            value of a type that JSON does not have.
    """
    from proposer_rl.settings import plain, shown  # not needed for help, and slow to import

    def named(inner: Any) -> str:
        if callable(inner):
            return _dotted(key, inner)
        said = "must be a number, a text, a list or a mapping of such"
        raise _refusal(f"{key}={shown(value)}: {said}")

    return json.loads(json.dumps(plain(value), default=named))


def _dotted(key: str, function: Any) -> str:
    dotted = f"{function.__module__}.{getattr(function, '__qualname__', '<nameless>')}"
    if function.__module__ == "__main__" or "<" in dotted:
        raise _refusal(
            f"{key}={dotted}: must be importable, as a class or function of a module is, so that "
            "eval and play can make it again"
        )
    return dotted


def available(group: str, folder: Path = CONFIG_FOLDER) -> list[str]:
    """Returns the names of the files of a group, such as ``method``, in a folder."""
    return sorted(file.stem for file in (folder / group).glob("*.yaml"))


HOW = {
    "task": "prl.tasks.NAME(...), from_gymnasium(env_id, ...) or one of",
    "method": "prl.curricula.NAME(...) or one of",
}


def as_recipe(argument: str, group: Group, given: Any) -> Recipe:
    """Returns a recipe that is given itself or by its name.

    Raises:
        ArgumentError: naming the argument, if it is neither.
    """
    if isinstance(given, Recipe) and given.group == group:
        return given
    if not isinstance(given, str) or given not in available(group):
        raise _refusal(f"{argument}={given!r}: must be {HOW[group]} {', '.join(available(group))}")
    return Recipe(group, given, (f"{group}={given}",))


@cache
def recipe_function(
    group: Group, name: str, around: Callable[..., Any] | None = None
) -> Callable[..., Recipe]:
    """Returns the function ``prl.curricula.NAME`` or ``prl.tasks.NAME``.

    Args:
        group: ``"task"`` or ``"method"``.
        name: of a file.
        around: makes the model that a method's file may have; its settings are accepted, too.

    Raises:
        AttributeError: if there is no such file, with those that there are.
    """
    if name not in available(group):
        raise AttributeError(f"there is no {name!r}; there are: {', '.join(available(group))}")
    from proposer_rl.settings import check_names, schema  # not needed for help

    words = (f"{group}={name}",)
    known: dict[str, dict[str, Parameter]] = {}  # by top-level key
    if group == "task":
        known["task"] = _over({}, composed(words).task)
    else:
        config = composed([NO_TASK, *words])
        make, _ = maker("curriculum", {"_target_": config.curriculum._target_})
        if around is not None and config.model is not None:
            known["model"] = _over(schema(around), config.model)
        known["curriculum"] = _over(schema(make), config.curriculum)
    parameters = {name: p for own in reversed(known.values()) for name, p in own.items()}

    def recipe(**given: Any) -> Recipe:
        check_names(parameters, given)
        by_key: dict[str, dict[str, Any]] = {}
        for setting, value in given.items():
            key = next(key for key in reversed(known) if setting in known[key])
            by_key.setdefault(key, {})[setting] = value
        return Recipe(group, name, words, by_key)

    about = next(comments(CONFIG_FOLDER / group / f"{name}.yaml"))
    recipe.__name__ = recipe.__qualname__ = name
    recipe.__doc__ = f"{about}\n\nThe file is conf/{group}/{name}.yaml."
    signature = Signature([*parameters.values()], return_annotation=Recipe)
    recipe.__signature__ = signature  # type: ignore[attr-defined]
    return recipe


def _over(known: Mapping[str, Parameter], file: DictConfig) -> dict[str, Parameter]:
    """Returns known settings with the defaults of a file, and further settings of the file."""
    found = dict(known)
    for name, value in plain_values(file).items():
        default = Parameter.empty if value == "???" else value  # Hydra's mark of a required value
        setting = known.get(name, Parameter(name, Parameter.KEYWORD_ONLY))
        found[name] = setting.replace(default=default)
    found.pop("_target_", None)
    return found


def composed(words: Sequence[str], *settings: Mapping[str, Any]) -> DictConfig:
    """Returns the configuration that Hydra composes, with settings merged into it.

    Args:
        words: overrides such as ``method=plr``.
        settings: by top-level key; of two values the later one counts.

    Raises:
        ArgumentError: for a file or key that does not exist, or a value that does not fit.
    """
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    try:
        # The settings of a teacher may contain functions.
        more = [OmegaConf.create(dict(s), flags={"allow_objects": True}) for s in settings]
        config: Any = OmegaConf.merge(_composed(tuple(words)), *more)
        return config
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        raise _refusal(explained(error)) from error


@lru_cache(64)
def _composed(words: tuple[str, ...]) -> DictConfig:
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.singleton import Singleton
    from omegaconf import OmegaConf

    with COMPOSING:
        before = Singleton.get_state()
        GlobalHydra.instance().clear()
        try:
            with initialize_config_dir(str(CONFIG_FOLDER), version_base="1.3"):
                config = compose("train", [*words])
        finally:
            Singleton.set_state(before)
    OmegaConf.set_struct(config, False)
    return config


def plain_values(config: Any, resolve: bool = False) -> dict[str, Any]:
    """Returns a part of a configuration as a dict, by default with references unresolved."""
    from omegaconf import OmegaConf

    values: Any = OmegaConf.to_container(config, resolve=resolve)
    return dict(values)


def maker(key: str, values: Mapping[str, Any]) -> tuple[Callable[..., Any], dict[str, Any]]:
    """Returns the function that a part of a configuration names, and the settings for its call.

    Args:
        key: of the configuration, such as ``curriculum``.
        values: at that key. ``_target_`` names a class or function; if it is a class with a method
            ``create``, that method is returned. Hydra instantiates values that have a ``_target_``
            themselves.

    Raises:
        ArgumentError: if ``_target_`` is missing, or cannot be imported.
    """
    from hydra.errors import HydraException
    from hydra.utils import instantiate

    if not isinstance(values.get("_target_"), str):
        raise _refusal(
            f"{key}._target_: missing: the class or function that makes the {key}; a file of "
            "your own can take it from another, as with `defaults: [gymnasium, _self_]`"
        )
    try:
        made = instantiate({**values, "_partial_": True}, _convert_="all")
        inspect.signature(made.func)
    except (HydraException, ImportError, AttributeError, TypeError, ValueError) as error:
        cause: BaseException = error
        while cause.__cause__ is not None:
            cause = cause.__cause__
        said = " ".join(str(cause).split())
        raise _refusal(f"{key}: {said}{where_to_look(cause)}") from error
    return getattr(made.func, "create", made.func), made.keywords


def explained(error: Exception) -> str:
    """Returns an error of Hydra's in one line; of an unknown file or key, with those that exist."""
    from hydra.errors import MissingConfigException

    from proposer_rl.settings import unknown

    if isinstance(error, MissingConfigException) and error.options:
        return unknown(str(error.missing_cfg_file), error.options)
    cause: Any = error.__cause__
    holder = getattr(cause, "parent_node", None)
    if isinstance(cause, AttributeError | KeyError) and isinstance(holder, Mapping):
        key = getattr(cause, "full_key", None)
        return unknown(str(key), sorted({*holder} - {"hydra"}))
    said = getattr(error, "override", None), error, cause
    return ": ".join(" ".join(str(each).split()) for each in said if each)


def comments(file: Path) -> Iterator[str]:
    """Yields the comment lines of a file, without the one that Hydra reads."""
    # Hydra itself refuses a file that is not UTF-8.
    for line in file.read_text(encoding="utf-8-sig", errors="replace").splitlines():
        if line.startswith("#") and not line.startswith("# @package"):
            yield line.lstrip("# ")


def _refusal(line: str) -> ValueError:
    from proposer_rl.settings import ArgumentError  # not needed for help, and slow to import

    return ArgumentError(line)

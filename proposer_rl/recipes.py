"""Tasks and curricula by name: what ``prl.tasks.maze()`` and ``prl.curricula.plr()`` return.

The names are those of the files in ``conf/task`` and ``conf/method``, which the command line reads,
too. Hydra composes them, and settings from Python are merged into what it has composed.
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
# In a wheel the configuration lies in the package, in a checkout beside it.
CONFIG_FOLDER = PACKAGE / "conf" if (PACKAGE / "conf").is_dir() else PACKAGE.parent / "conf"
DEFAULT_METHOD = "adaptive_mixture"  # for those who do not want to choose
NO_TASK = "~task"  # the word for Hydra with which no file of a task is composed
COMPOSING = RLock()  # Hydra composes with globals of the process
Group = Literal["task", "method"]


@dataclass(frozen=True)
class Recipe:
    """A task or a curriculum that is made when a run begins.

    Attributes:
        group: ``"task"`` or ``"method"``.
        name: of a file in that folder of the configuration; or of a function of one's own.
        words: that Hydra composes it from, as on the command line.
        settings: that are merged into what it has composed, by top-level key.
    """

    group: Group
    name: str
    words: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)


def own_recipe(group: Group, make: Callable[..., Any], **settings: Any) -> Recipe:
    """Returns a recipe for a class or function of one's own, which must be importable.

    Args:
        group: ``"task"``, or ``"method"`` for a curriculum.
        make: of a task, called with the settings, ``solver`` and ``context``; of a curriculum, a
            class with ``create`` or a function, see :func:`proposer_rl.methods.build`.
        settings: numbers, texts, lists and mappings.

    Raises:
        ArgumentError: if it cannot be imported by its name.
    """
    own = {"_target_": _dotted("make", make), **settings}
    if group == "method":
        return Recipe(group, make.__name__, (), {"method": make.__name__, "curriculum": own})
    # As most tasks call what is to be mastered; a headline that is given comes after it.
    schedule = {"headline": "target_success"}
    return Recipe(group, make.__name__, (NO_TASK,), {"task": own, "schedule": schedule})


def storable(key: str, value: Any) -> Any:
    """Returns a value as JSON has it, with the dotted names of functions in their place.

    Raises:
        ArgumentError: naming the key, for a function that cannot be imported by its name, and for
            what JSON has not.
    """
    from proposer_rl.settings import plain, shown  # which help does without

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
            "watch, eval and play can make it again"
        )
    return dotted


def available(group: str, folder: Path = CONFIG_FOLDER) -> list[str]:
    """Returns the names of a group's files, such as ``method``, in a folder of configurations."""
    return sorted(file.stem for file in (folder / group).glob("*.yaml"))


HOW = {
    "task": "prl.tasks.NAME(...), from_gymnasium(env_id, ...) or one of",
    "method": "prl.curricula.NAME(...) or one of",
}


def as_recipe(argument: str, group: Group, given: Any) -> Recipe:
    """Returns a recipe, also of its name.

    Raises:
        ArgumentError: naming the argument, if it is neither.
    """
    if isinstance(given, Recipe) and given.group == group:
        return given
    if not isinstance(given, str) or given not in available(group):
        raise _refusal(f"{argument}={given!r}: must be {HOW[group]} {', '.join(available(group))}")
    return Recipe(group, given, _words(group, given))


def _words(group: Group, name: str) -> tuple[str, ...]:
    return (f"{'+' if group == 'method' else ''}{group}={name}",)


@cache
def recipe_function(
    group: Group, name: str, around: Callable[..., Any] | None = None
) -> Callable[..., Recipe]:
    """Returns the function ``prl.curricula.NAME`` or ``prl.tasks.NAME``.

    Args:
        group: ``"task"`` or ``"method"``.
        name: of a file.
        around: makes the model that a method's file may have; its settings are the method's, too.

    Raises:
        AttributeError: if there is no such file, with those that there are.
    """
    if name not in available(group):
        raise AttributeError(f"there is no {name!r}; there are: {', '.join(available(group))}")
    from proposer_rl.settings import check_names, schema  # which help does without

    words = _words(group, name)
    known: dict[str, dict[str, Parameter]] = {}  # by the key that they stand below
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
    """Returns the settings of a file, and those of what makes an object of it."""
    found = dict(known)
    for name, value in plain_values(file).items():
        default = Parameter.empty if value == "???" else value  # to be given
        setting = known.get(name, Parameter(name, Parameter.KEYWORD_ONLY))
        found[name] = setting.replace(default=default)
    found.pop("_target_", None)
    return found


def composed(words: Sequence[str], *settings: Mapping[str, Any]) -> DictConfig:
    """Returns what Hydra composes from words such as ``+method=plr``, and settings merged into it.

    Args:
        words: as on the command line.
        settings: by top-level key; later ones win.

    Raises:
        ArgumentError: for what is in no file, or does not fit.
    """
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    try:
        # A teacher's settings may have functions in them.
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
    """Returns a part of a configuration as Python's own, references to other parts as they are."""
    from omegaconf import OmegaConf

    values: Any = OmegaConf.to_container(config, resolve=resolve)
    return dict(values)


def maker(key: str, values: Mapping[str, Any]) -> tuple[Callable[..., Any], dict[str, Any]]:
    """Returns what makes an object of a configuration, and the settings to call it with.

    Args:
        key: of the configuration, such as ``curriculum``.
        values: at that key. ``_target_`` names a class or function; of a class with a method
            ``create`` that one is returned. Values that have a ``_target_`` themselves are made by
            Hydra.

    Raises:
        ArgumentError: if nothing is named, or it cannot be imported.
    """
    from hydra.errors import HydraException
    from hydra.utils import instantiate

    if not isinstance(values.get("_target_"), str):
        raise _refusal(
            f"{key}._target_: missing: the class or function that makes the {key}; a file of "
            "your own has it from another, such as by `defaults: [gymnasium, _self_]`"
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
    """Returns one line on an error in composing: an unknown file or key with those that exist."""
    from hydra.errors import MissingConfigException, OverrideParseException
    from omegaconf import DictConfig
    from omegaconf.errors import ConfigAttributeError, ConfigKeyError

    if isinstance(error, MissingConfigException) and error.options:
        return f"{error.missing_cfg_file}: unknown; choose one of: {', '.join(error.options)}"
    said = " ".join(str(error).split())
    if isinstance(error, OverrideParseException):
        return f"{error.override}: {said}"
    cause: Any = error.__cause__
    if isinstance(cause, ConfigAttributeError | ConfigKeyError):
        holder = cause.parent_node
        if isinstance(holder, DictConfig):
            known = sorted(str(key) for key in holder if holder._get_full_key(key) != "hydra")
            return f"{cause.full_key}: unknown; there are: {', '.join(known) or 'none'}"
    return ": ".join(" ".join(str(each).split()) for each in (error, cause) if each)


def comments(file: Path) -> Iterator[str]:
    """Yields the lines of a file that begin with a #, without the one that Hydra reads."""
    # What is no UTF-8 is refused where it is used.
    for line in file.read_text(encoding="utf-8-sig", errors="replace").splitlines():
        if line.startswith("#") and not line.startswith("# @package"):
            yield line.lstrip("# ")


def _refusal(line: str) -> ValueError:
    from proposer_rl.settings import ArgumentError  # help needs none, and it takes time to import

    return ArgumentError(line)

"""One environment of Gymnasium that plays the levels that it is given."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cached_property, partial
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import gymnasium
from annotated_types import Len
from gymnasium.wrappers import TimeLimit

from proposer_rl.settings import settings
from proposer_rl.tasks.gymnasium.answers import (
    Step,
    SuccessSettings,
    UnfitEnvironmentError,
    stepped,
)
from proposer_rl.tasks.gymnasium.attributes import AttributeRefusedError, mismatch, write_attribute
from proposer_rl.tasks.gymnasium.spaces import Layout, typed
from proposer_rl.tasks.parameters import MOST_BINS, SEED
from proposer_rl.tasks.ranges import RangeSettings, value_text

# The dotted name of a function or class, or that with its further arguments by name.
WrapperSettings = str | Annotated[dict[str, dict[str, Any]], Len(1, 1)]


@settings
class ParameterSettings(RangeSettings):
    """A parameter of the environment that differs between levels: a number, a text or the like.

    Attributes:
        values: rising numbers; or texts, truth values, lists, each of which is set as it is.
        set: how it gets into the environment, before each reset: as an attribute, as an argument
            of the constructor (the environment is then built anew where it changes), as an option
            of the reset, or by a function that is called with the environment and the value.
        name: of the attribute (dots lead to parts of the environment, numbers to elements),
            argument, option or function (which must be given), or of several that all get the
            value; None for the parameter's own name.
        to: what the environment gets for each of ``values``, which are then numbers that say how
            they are ordered and how far apart they are.
    """

    values: Annotated[list[Any], Len(1, MOST_BINS)] | None = None
    target: Any
    set: Literal["attribute", "argument", "option", "call"] = "attribute"
    name: str | Annotated[list[str], Len(1)] | None = None
    to: list[Any] | None = None

    def __post_init__(self) -> None:
        if self.to is not None and len(self.to) != len(self.values or []):
            raise ValueError(f"to={self.to}: must be one for each of values={self.values}")

    def names(self, own: str) -> list[str]:
        """Returns the names that get the value of the parameter, whose own name is given."""
        name = own if self.name is None else self.name
        return [name] if isinstance(name, str) else name

    def given(self, value: Any) -> Any:
        """Returns what the environment gets for a value, a copy that it may change."""
        return deepcopy(value if self.to is None else self.to[(self.values or []).index(value)])


def wrapper_error(wrapper: WrapperSettings, error: Exception | str) -> UnfitEnvironmentError:
    """Returns what is wrong with a wrapper, as an error that another process can send."""
    name = wrapper if isinstance(wrapper, str) else next(iter(wrapper))
    reason = error if isinstance(error, str) else cause(error)
    return UnfitEnvironmentError(f"wrappers: {name}: {reason}")


@dataclass(frozen=True)
class MakeEnvironment:
    """Makes an environment; can be sent to another process.

    Attributes:
        env_id, arguments, max_steps, wrappers: as of
            :class:`~proposer_rl.tasks.gymnasium.task.GymnasiumTask`.
    """

    env_id: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    max_steps: int | None = None
    wrappers: Sequence[WrapperSettings] = ()

    def __call__(self, **arguments: Any) -> gymnasium.Env[Any, Any]:
        """Makes an environment with further arguments.

        Raises:
            UnfitEnvironmentError: if a wrapper cannot be put around it.
        """
        env: gymnasium.Env[Any, Any] = gymnasium.make(
            self.env_id,
            max_episode_steps=-1,
            disable_env_checker=True,
            **{**self.arguments, **arguments},
        )
        limit = self.limit(env)
        if limit is not None:
            env = TimeLimit(env, limit)
        for wrapper in self.wrappers:
            try:
                env = wrapper_of(wrapper)(env)
            except Exception as error:
                raise wrapper_error(wrapper, error) from error
        return env

    def limit(self, env: gymnasium.Env[Any, Any]) -> int | None:
        """Returns the steps after which an episode is truncated; None for never."""
        limits = [limit._max_episode_steps for limit in _time_limits(env)]
        declared = self.max_steps
        if declared is None and env.unwrapped.spec is not None:
            declared = gymnasium.spec(env.unwrapped.spec.id).max_episode_steps
        if declared is not None:
            limits.append(declared)
        return min(limits, default=None)


class GymLevel(NamedTuple):
    """A level: values of the parameters by name, and the seed of every reset."""

    values: Mapping[str, Any]
    seed: int

    @property
    def lines(self) -> list[str]:
        """Returns the parameters' values in lines, as they are shown."""
        return [f"{name} {value_text(value, 4)}" for name, value in self.values.items()]

    def __str__(self) -> str:
        """Returns the level as a text."""
        values = [f"{name}={value_text(value)}" for name, value in self.values.items()]
        return ", ".join([*values, f"{SEED}={self.seed}"])


class LevelPlayer(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment whose resets set up the level that it plays.

    An info has ``success`` alone, where a step ended an episode that is one.

    Args:
        make, parameters: the environment, and what differs between levels, by name.
        play: the first level.
        success: when an episode is one; None where nobody asks.
        once: stand still after the first episode of a level, for evaluations.

    Attributes:
        last_info: that of the last reset or step.
    """

    _seen: Any  # at last

    def __init__(
        self,
        make: MakeEnvironment,
        parameters: Mapping[str, ParameterSettings],
        play: GymLevel,
        success: SuccessSettings | None = None,
        once: bool = False,
    ) -> None:
        self.make, self.parameters = make, parameters
        self._success, self._once = success, once
        self._ways = [
            (name, settings.set, path)
            for name, settings in parameters.items()
            for path in settings.names(name)
        ]
        self.play = play
        super().__init__(self._built())
        self.last_info: Mapping[str, Any] = {}

    @property
    def play(self) -> GymLevel:
        """Returns what is played from the next reset on."""
        return self._play

    @play.setter
    def play(self, play: GymLevel) -> None:
        self._play, self._played, self._still = play, False, False

    @cached_property
    def layout(self) -> Layout:
        """Returns how a Solver sees the environment and acts in it."""
        return Layout(self.observation_space, self.action_space)

    @property
    def in_time(self) -> bool:
        """Returns whether no time limit is reached, each counting the steps that it has seen."""
        return all(
            (limit._elapsed_steps or 0) < limit._max_episode_steps
            for limit in _time_limits(self.env)
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins an episode on the level, which has its own seed and options."""
        if self._once and self._played:
            self._still = True
            return self._seen, {}
        self._played, self._return, self._succeeded = True, 0.0, False
        self._set_up()
        given = self._named("option")
        try:
            seen, self.last_info = self.env.reset(
                seed=self._play.seed, **({"options": given} if given else {})
            )
            self._seen = typed(self.observation_space, seen)
        except UnfitEnvironmentError as error:
            raise UnfitEnvironmentError(f"{error}, on the level {self._play}") from error
        except Exception as error:
            raise self._refused(error) from error
        return self._seen, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Takes a step, unless the episode of an evaluation is over."""
        if self._still:
            return self._seen, 0.0, False, False, {}
        rule = self._success
        try:
            answer = stepped(self.env.step(action))
            seen, reward, terminated, truncated, self.last_info = answer
            self._seen = typed(self.observation_space, seen)
            self._return += reward
            over = terminated or truncated
            if rule is not None and (over or rule.once):
                step = Step(terminated, truncated, self.in_time, self._return, self.last_info)
                self._succeeded = rule(step) or self._succeeded
        except Exception as error:  # whatever an environment of somebody's may raise
            unfit = isinstance(error, UnfitEnvironmentError)
            said = str(error) if unfit else f"step raises {cause(error)}"
            raise UnfitEnvironmentError(f"{said}, on the level {self._play}") from error
        info = {"success": True} if over and self._succeeded else {}
        return self._seen, reward, terminated, truncated, info

    def mismatches(self) -> str | None:
        """Returns a line on what of the level the environment has lost; None where all is there."""
        for name, how, path in self._ways:
            line = how == "attribute" and mismatch(self.env, path, self._value(name))
            if line:
                return f"parameters.{name}: {line}"
        return None

    def _set_up(self) -> None:
        if self._named("argument") != self._arguments:
            self.env.close()
            self.env = self._built()
        inner = self.env.unwrapped
        for name, how, path in self._ways:
            value = self._value(name)
            if how == "attribute":
                try:
                    write_attribute(inner, path, value)
                except AttributeRefusedError as error:
                    raise UnfitEnvironmentError(f"parameters.{name}: {error}") from error
            elif how == "call":
                try:
                    imported(path)(inner, value)
                except Exception as error:
                    raise self._refused(error) from error

    def _built(self) -> gymnasium.Env[Any, Any]:
        self._arguments = self._named("argument")
        try:
            return self.make(**self._arguments)
        except (ImportError, gymnasium.error.Error, UnfitEnvironmentError):
            raise
        except Exception as error:
            if self._arguments:
                raise self._refused(error) from error
            raise UnfitEnvironmentError(f"it cannot be made: {cause(error)}") from error

    def _named(self, way: str) -> dict[str, Any]:
        """Returns the values that are set in one way, by the names that they have there."""
        return {name: self._value(parameter) for parameter, how, name in self._ways if how == way}

    def _value(self, parameter: str) -> Any:
        return self.parameters[parameter].given(self._play.values[parameter])

    def _refused(self, error: Exception) -> UnfitEnvironmentError:
        return UnfitEnvironmentError(
            f"parameters: {self.make.env_id} refuses {self._play}: {cause(error)}"
        )


def _time_limits(env: Any) -> Iterator[TimeLimit]:
    while isinstance(env, gymnasium.Wrapper):
        if isinstance(env, TimeLimit):
            yield env
        env = env.env


def wrapper_of(settings: WrapperSettings) -> Callable[..., Any]:
    """Returns what puts a wrapper around an environment.

    Raises:
        ValueError: if there is no such thing.
    """
    if isinstance(settings, str):
        return imported(settings)
    ((name, arguments),) = settings.items()
    return partial(imported(name), **arguments)


def imported(name: str) -> Callable[..., Any]:
    """Returns what a dotted name stands for.

    Raises:
        ValueError: if there is no such thing.
    """
    module, _, last = name.rpartition(".")
    try:
        result = getattr(import_module(module), last)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"{name!r}: cannot be imported: {error}") from error
    if not callable(result):
        raise ValueError(f"{name!r}: must be something to call")
    return result


def cause(error: Exception) -> str:
    """Returns an environment's exception as part of a line, with the place that raised it."""
    *_, last = traceback.extract_tb(error.__traceback__)
    reason = " ".join(str(error).split()) or "no reason given"
    return f"{type(error).__name__}: {reason} ({Path(last.filename).name}, line {last.lineno})"

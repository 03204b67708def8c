"""Makes a Gymnasium environment and plays levels in it."""

from __future__ import annotations

import traceback
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, Any, Literal, NamedTuple

import gymnasium
import numpy as np
from annotated_types import Len
from gymnasium.wrappers import TimeLimit

from proposer_rl.settings import settings
from proposer_rl.tasks.gymnasium.environment import (
    SuccessSettings,
    UnfitEnvironmentError,
    mismatch,
    write_attribute,
)
from proposer_rl.tasks.gymnasium.spaces import cast_to
from proposer_rl.tasks.parameters import MOST_BINS, SEED
from proposer_rl.tasks.ranges import RangeSettings, value_text

# The dotted name of a function or class; or a mapping from it to its further arguments.
WrapperSettings = str | Annotated[dict[str, dict[str, Any]], Len(1, 1)]


@settings
class ParameterSettings(RangeSettings):
    """Settings of a parameter that differs between levels: a number, a text, a list or the like.

    Attributes:
        values: rising numbers; or texts, truth values or lists, which are set as they are.
        set: how the environment gets the value before each reset: as an attribute; as an argument
            of its constructor, which is called again when the value changes; as an option of the
            reset; or by a function, called with the environment and the value.
        name: of the attribute (dots lead to parts of the environment, numbers to elements),
            argument, option or function, or several names that all get the value; None for the
            parameter's own name.
        to: what the environment gets in place of each of ``values``, which are then numbers that
            say how the choices are ordered and how far apart they are.
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
        """Returns the names that get the value of a parameter with this own name."""
        name = own if self.name is None else self.name
        return [name] if isinstance(name, str) else name

    def given(self, value: Any) -> Any:
        """Returns what the environment gets for a value, as a copy that it may change."""
        return deepcopy(value if self.to is None else self.to[(self.values or []).index(value)])


@dataclass(frozen=True)
class MakeEnvironment:
    """Makes an environment when it is called, also in another process.

    Attributes:
        env_id, arguments, max_steps, wrappers: as in
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
            max_episode_steps=self.max_steps,
            disable_env_checker=True,
            **{**self.arguments, **arguments},
        )
        for wrapper in self.wrappers:
            ((name, given),) = ({wrapper: {}} if isinstance(wrapper, str) else wrapper).items()
            try:
                env = import_object(name)(env, **given)
            except Exception as error:
                raise UnfitEnvironmentError(f"wrappers: {name}: {cause(error)}") from error
        return env


class GymLevel(NamedTuple):
    """A level: the parameters' values by name, and the seed of every reset."""

    values: Mapping[str, Any]
    seed: int

    @property
    def lines(self) -> list[str]:
        """Returns a line of text for each parameter."""
        return [f"{name} {value_text(value, 4)}" for name, value in self.values.items()]

    def __str__(self) -> str:
        """Returns the level in one line, with the seed."""
        values = [f"{name}={value_text(value)}" for name, value in self.values.items()]
        return ", ".join([*values, f"{SEED}={self.seed}"])


class LevelPlayer(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Sets an environment up for a level at every reset.

    Its info is empty but for ``success`` at the end of a successful episode.

    Args:
        make: makes the environment.
        parameters: what differs between levels, by name.
        play: the first level.
        success: when an episode is a success; None to leave that out.
        once: whether to play one episode of a level and then stand still, for evaluations.
    """

    _seen: Any  # the last observation

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

    @property
    def play(self) -> GymLevel:
        """Returns the level that is played from the next reset on."""
        return self._play

    @play.setter
    def play(self, play: GymLevel) -> None:
        self._play, self._played, self._still = play, False, False

    @property
    def in_time(self) -> bool:
        """Returns whether no wrapper has reached its time limit."""
        return all(
            (limit._elapsed_steps or 0) < limit._max_episode_steps
            for limit in time_limits(self.env)
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins an episode on the level, with the level's own seed and options."""
        if self._once and self._played:
            self._still = True
            return self._seen, {}
        self._played, self._return, self._succeeded = True, 0.0, False
        self._set_up()
        given = self._named("option")
        try:
            seen, _ = self.env.reset(seed=self._play.seed, **({"options": given} if given else {}))
            self._seen = cast_to(self.observation_space, seen)
        except Exception as error:
            raise self._fault("reset", error) from error
        return self._seen, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Takes a step, unless the only episode of an evaluation is over."""
        if self._still:
            return self._seen, 0.0, False, False, {}
        rule = self._success
        try:
            seen, paid, *ends, info = self.env.step(action)
            reward = paid if type(paid) is float else float(np.asarray(paid).item())
            terminated, truncated = map(bool, ends)
            self._seen = cast_to(self.observation_space, seen)
            self._return += reward
            over = terminated or truncated
            if rule is not None and (over or rule.once):
                said = terminated, truncated, self.in_time, self._return, info
                self._succeeded |= rule(*said)
        except Exception as error:
            raise self._fault("step", error) from error
        told = {"success": True} if over and self._succeeded else {}
        return self._seen, reward, terminated, truncated, told

    def mismatches(self) -> str | None:
        """Describes an attribute that does not have the level's value in a line; None for none."""
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
            try:
                if how == "attribute":
                    write_attribute(inner, path, self._value(name))
                elif how == "call":
                    import_object(path)(inner, self._value(name))
            except Exception as error:
                raise UnfitEnvironmentError(f"parameters.{name}: {cause(error)}") from error

    def _built(self) -> gymnasium.Env[Any, Any]:
        self._arguments = self._named("argument")
        try:
            return self.make(**self._arguments)
        except (ImportError, gymnasium.error.Error):
            raise
        except Exception as error:
            raise self._fault("the constructor", error) from error

    def _named(self, way: str) -> dict[str, Any]:
        """Returns the values that are set in one way, by the names to which they go."""
        return {name: self._value(parameter) for parameter, how, name in self._ways if how == way}

    def _value(self, parameter: str) -> Any:
        return self.parameters[parameter].given(self._play.values[parameter])

    def _fault(self, doing: str, error: Exception) -> UnfitEnvironmentError:
        """Returns an exception of the environment as an error that names the level."""
        raises = "" if isinstance(error, UnfitEnvironmentError) else f"{doing} raises "
        return UnfitEnvironmentError(f"{raises}{cause(error)}, on the level {self._play}")


def time_limits(env: Any) -> Iterator[TimeLimit]:
    """Yields the wrappers that limit the steps of an environment's episodes."""
    while isinstance(env, gymnasium.Wrapper):
        if isinstance(env, TimeLimit):
            yield env
        env = env.env


def import_object(name: str) -> Any:
    """Imports a function or class by its dotted name.

    Raises:
        UnfitEnvironmentError: if there is none.
    """
    try:
        return resolve_name(name)
    except (ImportError, AttributeError, ValueError) as error:
        raise UnfitEnvironmentError(f"{name!r} cannot be imported: {error}") from error


def cause(error: Exception) -> str:
    """Returns an exception in one line, with the file and line that raised it unless it is ours."""
    if isinstance(error, UnfitEnvironmentError):
        return str(error)
    *_, last = traceback.extract_tb(error.__traceback__)
    reason = " ".join(str(error).split()) or "no reason given"
    return f"{type(error).__name__}: {reason} ({Path(last.filename).name}, line {last.lineno})"

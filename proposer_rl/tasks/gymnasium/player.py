"""One environment of Gymnasium that plays the levels that it is given."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from numbers import Number
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import ClipAction, RescaleAction

from proposer_rl.tasks.gymnasium.settings import ParameterSettings


class RefusedLevelError(ValueError):
    """The environment does not take a level; the message is one line."""

    exit_code = 2


@dataclass(frozen=True)
class MakeEnvironment:
    """Makes an environment; can be sent to another process.

    Attributes:
        env_id: as :func:`gymnasium.make` takes it, ``module:name`` included.
        arguments: of its constructor.
        max_steps: after which an episode is truncated; None for the environment's own limit.
        wrappers: dotted names of what is put around it, the innermost first.
        render_mode: None, or ``"rgb_array"``.
    """

    env_id: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    max_steps: int | None = None
    wrappers: Sequence[str] = ()
    render_mode: str | None = None

    def __call__(self, **arguments: Any) -> gymnasium.Env[Any, Any]:
        """Make one with further arguments; actions of a bounded box go from -1 to 1."""
        env = gymnasium.make(
            self.env_id,
            max_episode_steps=self.max_steps,
            disable_env_checker=True,
            render_mode=self.render_mode,
            **{**self.arguments, **arguments},
        )
        for wrapper in self.wrappers:
            env = imported(wrapper)(env)
        if isinstance(env.action_space, spaces.Box):
            if env.action_space.is_bounded():
                env = RescaleAction(env, np.float32(-1), np.float32(1))
            env = ClipAction(env)
        return env


class Play(NamedTuple):
    """What a player is to play.

    Attributes:
        values: of the parameters, by name.
        seed: of every reset.
        once: stand still after the first episode, for evaluations.
    """

    values: Mapping[str, float]
    seed: int
    once: bool = False


class LevelPlayer(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment whose resets set up the level that it plays.

    Args:
        make: the environment.
        parameters: what differs between levels, by name.
        play: the first level.
    """

    _seen: Any  # at last

    def __init__(
        self, make: MakeEnvironment, parameters: Mapping[str, ParameterSettings], play: Play
    ) -> None:
        self._make = make
        self._ways = {
            name: (settings.set, settings.name or name) for name, settings in parameters.items()
        }
        self._arguments = self._named("argument", play)
        super().__init__(self._built(play))
        self.play = play

    @property
    def play(self) -> Play:
        """What is played from the next reset on."""
        return self._play

    @play.setter
    def play(self, play: Play) -> None:
        self._play, self._played, self._still = play, False, False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode on the level, whose seed and options are its own."""
        if self._play.once and self._played:
            self._still = True
            return self._seen, {}
        self._played = True
        self._set_up()
        options = self._named("option", self._play) or None
        try:
            self._seen, info = self.env.reset(seed=self._play.seed, options=options)
        except Exception as error:
            raise self._refused(self._play, error) from error
        return self._seen, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """One step, unless it stands still."""
        if self._still:
            return self._seen, 0.0, False, False, {}
        self._seen, *rest = self.env.step(action)
        return self._seen, *rest

    def _set_up(self) -> None:
        arguments = self._named("argument", self._play)
        if arguments != self._arguments:
            self.env.close()
            self.env, self._arguments = self._built(self._play), arguments
        inner = self.env.unwrapped
        for path, value in self._named("attribute", self._play).items():
            set_attribute(inner, path, value)
        for function, value in self._named("call", self._play).items():
            try:
                imported(function)(inner, value)
            except Exception as error:
                raise self._refused(self._play, error) from error

    def _built(self, play: Play) -> gymnasium.Env[Any, Any]:
        try:
            return self._make(**self._named("argument", play))
        except (ImportError, gymnasium.error.Error):
            raise
        except Exception as error:
            raise self._refused(play, error) from error

    def _named(self, way: str, play: Play) -> dict[str, float]:
        """The values that get into the environment in one way, by the names they have there."""
        return {
            name: play.values[parameter]
            for parameter, (how, name) in self._ways.items()
            if how == way
        }

    def _refused(self, play: Play, error: Exception) -> RefusedLevelError:
        level = ", ".join(f"{name}={value:g}" for name, value in play.values.items())
        reason = " ".join(str(error).split()) or "no reason given"
        kind = type(error).__name__
        return RefusedLevelError(f"{self._make.env_id} refuses {level}: {kind}: {reason}")


def set_attribute(environment: Any, path: str, value: float) -> None:
    """Set an attribute that an environment has.

    Args:
        environment: without wrappers.
        path: the attribute's name; dots lead to parts of the environment.
        value: for it.

    Raises:
        RefusedLevelError: if there is no such attribute, listing the available ones.
    """
    *parts, last = path.split(".")
    place = environment
    for part in parts:
        place = getattr(place, part, None)
    if not hasattr(place, last):
        there = sorted(
            name
            for name, value in (*vars(type(environment)).items(), *vars(environment).items())
            if isinstance(value, Number) and not isinstance(value, bool) and name[0] != "_"
        )
        raise RefusedLevelError(
            f"{type(environment).__name__} has no attribute {path!r}; numbers that it has: "
            f"{', '.join(there) or 'none'}"
        )
    setattr(place, last, value)


def imported(name: str | None) -> Callable[..., Any]:
    """What a dotted name stands for.

    Raises:
        ValueError: if there is no such thing.
    """
    if name is None:
        raise ValueError("missing: which function, as module.name")
    module, _, last = name.rpartition(".")
    try:
        result = getattr(import_module(module), last)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"{name!r}: cannot be imported: {error}") from error
    if not callable(result):
        raise ValueError(f"{name!r}: must be something to call")
    return result

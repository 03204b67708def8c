"""Curricula in Gymnasium's loops: a wrapper that gives each episode its level."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from torch import Tensor

from proposer_rl.settings import ArgumentError
from proposer_rl.tasks.gymnasium.environment import (
    UnfitEnvironmentError,
    as_number,
    entries,
    mismatch,
    read_step,
    write_attribute,
)
from proposer_rl.tasks.parameters import SEED
from proposer_rl.teaching.remote import TeacherClient
from proposer_rl.teaching.teacher import Teacher

SUCCESS = ("success", "is_success")  # entries of an info that mean it


class TaughtEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment that asks a teacher for a level at every reset, and reports every episode.

    ``info`` has the ``level`` and its ticket ``level_id`` after a reset and after the last step.
    Wrappers that end episodes, as ``TimeLimit``, belong inside: an episode that a reset cuts off
    counts for nothing, of which the second warns. In vector environments every environment has its
    wrapper, and all of them the same teacher, in other processes its client. An environment has one
    ``TaughtEnv``: a second one around it is refused, and one that is put around what is inside
    takes the place of the first.

    Args:
        env: the environment.
        teacher: in another process than its own, its client.
        set: how a level gets into the environment before its reset: attributes of the unwrapped
            environment by the parameters' names, as in ``{"gravity": "model.opt.gravity.2"}``; or a
            function of the unwrapped environment and the level; or ``"options"`` for those of the
            reset. A level's ``seed`` is that of the reset.
        success: whether an episode was one: ``"terminated"``, ``"truncated"``, another entry of the
            last info (``"metrics.won"`` is an entry of an entry), or a function of that; None for
            its entry ``success`` or ``is_success``.
        once: whether it may be one in any step, so that what is reached and lost again counts.
        reset_truncates: whether a reset truncates an episode that has begun, which then counts, as
            where wrappers outside end episodes.

    Raises:
        ArgumentError: if the environment has a ``TaughtEnv``, or the curriculum reads rollouts; at
            a reset, if the environment has no such attribute, more than a number there, or another
            value afterwards; in a step, if it returns something else than Gymnasium's interface
            says; at the first end, if the curriculum reads success and nothing says it; later, if
            another ``TaughtEnv`` has taken this one's place.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        teacher: Teacher | TeacherClient,
        set: Mapping[str, str] | Callable[[Any, Any], object] | str,
        *,
        success: str | Callable[[Mapping[str, Any]], Any] | None = None,
        once: bool = False,
        reset_truncates: bool = False,
    ) -> None:
        inner = env
        while isinstance(inner, gymnasium.Wrapper):
            if isinstance(inner, TaughtEnv):
                raise ArgumentError(
                    "env: has a TaughtEnv already, as where a cell is run twice: each would set a "
                    "level of its own; make the environment anew, or give env.unwrapped"
                )
            inner = inner.env
        super().__init__(env)
        if "rollout" in teacher.required_results:
            raise ArgumentError("teacher: its curriculum reads rollouts, which this does not give")
        if isinstance(set, str) and set != "options":
            raise ArgumentError(f"set={set!r}: must be attributes, a function or 'options'")
        # By which an environment knows its teacher, and a copy of it that of the copy.
        self._own = self.unwrapped._taught = [id(self)]  # type: ignore[attr-defined]
        self._teacher, self._how, self._rule = teacher, set, success
        self._once, self._reset_truncates = once, reset_truncates
        self._ticket: int | None = None
        self._began = False  # any episode
        self._cut_off = 0  # episodes

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins an episode on the next level."""
        self._require_own()
        self._drop()
        self._ticket, self._level = self._teacher.ask()
        self._return, self._steps = 0.0, 0
        self._succeeded: float | None = None
        if callable(self._how):
            self._how(self.env.unwrapped, self._level)
        elif isinstance(self._how, str):
            options = {**(options or {}), **self._level}
        else:
            self._set(self._how)
        if isinstance(self._level, Mapping):
            seed = _plain(self._level.get(SEED, seed))
        observation, info = self.env.reset(seed=seed, options=options)
        if isinstance(self._how, Mapping):
            for name, path in self._how.items():
                if line := mismatch(self.env, path, _plain(self._level[name])):
                    raise ArgumentError(
                        f"set.{name}={path!r}: {line}, after a reset; give a function that sets "
                        "it where it stays"
                    )
        return observation, self._marked(info)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Makes a step; after the last one of an episode the teacher gets return and success."""
        self._require_own()
        try:
            answer = read_step(self.env.step(action))
        except UnfitEnvironmentError as error:
            raise ArgumentError(f"env: {error}") from error
        observation, reward, terminated, truncated, info = answer
        if self._ticket is not None:
            self._return += reward
            self._steps += 1
            over = terminated or truncated
            if over:
                info = self._marked(info)
            self._last = {**info, "terminated": terminated, "truncated": truncated}
            if over:
                self._end()
            elif self._once:
                self._note(self._success())
        return observation, reward, terminated, truncated, info

    def _require_own(self) -> None:
        if self.unwrapped._taught is not self._own:  # type: ignore[attr-defined]
            raise ArgumentError("env: another TaughtEnv has been put around it since; use that")

    def _end(self) -> None:
        """Reports the episode to the teacher."""
        self._note(self._success())
        needed = self._rule is not None or "success" in self._teacher.required_results
        if self._succeeded is None and needed:
            own = {name: self._last[name] for name in self._last.keys() - {"level", "level_id"}}
            known = "gives None of the last info", "the last info has no such entry"
            raise ArgumentError(
                f"success={self._rule!r}: {known[not callable(self._rule)]}; give one that it has, "
                f"{', '.join(sorted(name for name, _ in entries(own)))}, or a function"
            )
        self._teacher.tell(self._ticket, self._return, self._succeeded, steps=self._steps)
        self._ticket = None

    def _drop(self) -> None:
        """Drops the episode that is played, if there is one."""
        if self._ticket is None:
            return
        if self._steps and self._reset_truncates:
            self._last = {**self._marked(self._last), "truncated": True}
            self._end()
            return
        self._cut_off += bool(self._steps)
        if self._steps and self._cut_off == 2:  # one alone may well be meant
            warnings.warn(
                "TaughtEnv: a second episode was cut off by a reset; such episodes count for "
                "nothing. Put wrappers that end episodes inside, as in TaughtEnv(TimeLimit(env, "
                "200), ...), or give reset_truncates=True",
                stacklevel=3,
            )
        self._teacher.drop(self._ticket)

    def _set(self, how: Mapping[str, str]) -> None:
        """Sets attributes of the environment to the values of the level."""
        names = [*self._level.keys()] if isinstance(self._level, Mapping) else []
        for name, path in how.items():
            try:
                write_attribute(self.env.unwrapped, path, _plain(self._level[name]))
            except UnfitEnvironmentError as error:
                raise ArgumentError(f"set.{name}={path!r}: {error}") from error
        left_out = [name for name in names if name not in (*how, SEED)]
        if left_out and not self._began:
            warnings.warn(
                f"set: leaves out {', '.join(left_out)}, which the environment then never gets: "
                "the curriculum chooses among values that change nothing",
                stacklevel=3,
            )
        self._began = True

    def _marked(self, info: Mapping[str, Any]) -> dict[str, Any]:
        return {**info, "level": self._level, "level_id": self._ticket}

    def _success(self) -> Any:
        """Returns what the last step says of success; None where it says nothing."""
        rule = self._rule
        if callable(rule):
            return rule(self._last)
        known = dict(entries(self._last))
        return next((known[n] for n in ((rule,) if rule else SUCCESS) if n in known), None)

    def _note(self, success: Any) -> None:
        if success is None:
            return
        try:
            now = as_number(success, f"success={self._rule!r}: what came of an episode")
        except UnfitEnvironmentError as error:
            raise ArgumentError(str(error)) from error
        self._succeeded = max(now, self._succeeded or 0.0) if self._once else now


def _plain(value: Any) -> Any:
    """Returns a number as Python's own, since environments take no tensors."""
    one = isinstance(value, np.generic) or (isinstance(value, Tensor) and value.numel() == 1)
    return value.item() if one else value

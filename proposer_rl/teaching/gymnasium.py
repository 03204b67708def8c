"""Curricula in Gymnasium's loops: a wrapper that gives each episode its level."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from torch import Tensor

from proposer_rl.settings import ArgumentError, within
from proposer_rl.tasks.gymnasium.environment import entries, mismatch, write_attribute
from proposer_rl.tasks.parameters import SEED
from proposer_rl.teaching.remote import TeacherClient
from proposer_rl.teaching.teacher import Teacher

SUCCESS = ("success", "is_success")  # entries of an info that say it, if no rule is given


class TaughtEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Asks a teacher for a level at every reset, and tells it the result of every episode.

    ``info`` has the ``level`` and its ticket ``level_id`` after a reset and after the last step.
    Put wrappers that end episodes, such as ``TimeLimit``, inside: an episode that a reset cuts off
    is dropped, and the second one is warned of. In a vector environment, wrap every environment
    with the same teacher, or in other processes with its client. An environment has one
    ``TaughtEnv``: a second one around it is refused, and a new one around its inner environment
    replaces the first.

    Args:
        env: the environment.
        teacher: the teacher, or in another process its client.
        set: how a level gets into the environment before its reset: paths of attributes of the
            unwrapped environment by parameter, as in ``{"gravity": "model.opt.gravity.2"}``; a
            function of the unwrapped environment and the level; or ``"options"``, to pass the level
            on as the reset's options. A level's ``seed`` becomes that of the reset.
        success: whether an episode was a success: ``"terminated"``, ``"truncated"``, another entry
            of the last info (``"metrics.won"`` for an entry of an entry), or a function of the last
            info; None for the entry ``success`` or ``is_success``.
        once: whether an episode is a success if any of its steps was, not only the last.

    Raises:
        ArgumentError: if the environment has a ``TaughtEnv``; at a reset, if an attribute is
            missing, not a single number, or has another value afterwards; at the end of an episode,
            if nothing says whether it was a success but a rule was given or the curriculum requires
            it; later, if another ``TaughtEnv`` has replaced this one.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        teacher: Teacher | TeacherClient,
        set: Mapping[str, str] | Callable[[Any, Any], object] | str,
        *,
        success: str | Callable[[Mapping[str, Any]], Any] | None = None,
        once: bool = False,
    ) -> None:
        inner = env
        while isinstance(inner, gymnasium.Wrapper):
            if isinstance(inner, TaughtEnv):
                raise ArgumentError(
                    "env: has a TaughtEnv already, as happens when a cell is run twice; make the "
                    "environment anew, or wrap env.unwrapped"
                )
            inner = inner.env
        super().__init__(env)
        # The environment knows its wrapper by this list; a deep copy of both has its own.
        self._own = self.unwrapped._taught = [id(self)]  # type: ignore[attr-defined]
        self._teacher, self._how, self._rule = teacher, set, success
        self._once = once
        self._ticket: int | None = None
        self._began = False  # any episode
        self._cut_off = 0  # number of episodes

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
        elif self._how == "options":
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

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Makes a step; after the last one of an episode, tells the teacher its result."""
        self._require_own()
        observation, reward, terminated, truncated, info = self.env.step(action)
        if self._ticket is not None:
            self._return += float(reward)
            self._steps += 1
            over = terminated or truncated
            if over:
                info = self._marked(info)
            self._last = {**info, "terminated": terminated, "truncated": truncated}
            if over:
                self._end()
            elif self._once:
                self._note_success()
        return observation, reward, terminated, truncated, info

    def _require_own(self) -> None:
        if self.unwrapped._taught is not self._own:  # type: ignore[attr-defined]
            raise ArgumentError("env: another TaughtEnv was put around it since; use that one")

    def _end(self) -> None:
        """Tells the teacher the result of the episode."""
        self._note_success()
        needed = self._rule is not None or "success" in self._teacher.required_results
        if self._succeeded is None and needed:
            own = {name: self._last[name] for name in self._last.keys() - {"level", "level_id"}}
            raise ArgumentError(
                f"success={self._rule!r}: the last info of an episode does not have it, or the "
                f"function returned None; give a function or one of its entries: "
                f"{', '.join(sorted(name for name, _ in entries(own)))}"
            )
        self._teacher.tell(self._ticket, self._return, self._succeeded, steps=self._steps)
        self._ticket = None

    def _drop(self) -> None:
        """Drops the episode that is being played, if there is one."""
        if self._ticket is None:
            return
        self._cut_off += bool(self._steps)
        if self._steps and self._cut_off == 2:  # a single one may well be intended
            warnings.warn(
                "TaughtEnv: a second episode was cut off by a reset; such episodes are dropped. "
                "Put wrappers that end episodes inside, as in TaughtEnv(TimeLimit(env, 200), ...)",
                stacklevel=3,
            )
        self._teacher.drop(self._ticket)

    def _set(self, how: Any) -> None:
        """Sets attributes of the environment to the values of the level."""
        for name, path in how.items():
            with within(f"set.{name}={path!r}", ValueError):
                write_attribute(self.env.unwrapped, path, _plain(self._level[name]))
        names = self._level.keys() if isinstance(self._level, Mapping) else ()
        left_out = [name for name in names if name not in (*how, SEED)]
        if left_out and not self._began:
            warnings.warn(
                f"set: leaves out {', '.join(left_out)}, so that the curriculum chooses among "
                "values that change nothing in the environment",
                stacklevel=3,
            )
        self._began = True

    def _marked(self, info: Mapping[str, Any]) -> dict[str, Any]:
        return {**info, "level": self._level, "level_id": self._ticket}

    def _note_success(self) -> None:
        """Notes what the last step says about success, if it says anything."""
        if callable(self._rule):
            success = self._rule(self._last)
        else:
            known, names = dict(entries(self._last)), (self._rule,) if self._rule else SUCCESS
            success = next((known[name] for name in names if name in known), None)
        if success is not None:
            now = float(np.asarray(success).item())
            self._succeeded = max(now, self._succeeded or 0.0) if self._once else now


def _plain(value: Any) -> Any:
    """Returns a number as Python's own, since environments take no tensors."""
    one = isinstance(value, np.generic) or (isinstance(value, Tensor) and value.numel() == 1)
    return value.item() if one else value

"""Curricula in Gymnasium's loops: a wrapper that gives each episode its level."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, SupportsFloat

import gymnasium
from torch import Tensor

from proposer_rl.settings import ArgumentError
from proposer_rl.tasks.gymnasium.attributes import AttributeRefusedError, read, write
from proposer_rl.tasks.parameters import SEED
from proposer_rl.teaching.remote import TeacherClient
from proposer_rl.teaching.teacher import Teacher

SUCCESS = ("success", "is_success")  # entries of an info that mean it


class TaughtEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment that asks for a level at every reset, and tells at the end of the episode.

    ``info`` has the ``level`` and its ticket ``level_id`` after a reset and after the last step. An
    episode that a reset cuts off counts for nothing. In vector environments every environment has
    its wrapper, and all of them the same teacher, in other processes its client.

    Args:
        env: the environment.
        teacher: of one student; in another process than its own, its client.
        set: how a level gets into the environment before its reset: attributes of the unwrapped
            environment by the parameters' names, as in ``{"gravity": "model.opt.gravity.2"}``; or a
            function of the unwrapped environment and the level; or ``"options"`` for those of the
            reset. A level's ``seed`` is that of the reset.
        success: whether an episode was one: ``"terminated"``, ``"truncated"``, another entry of the
            last info, or a function of that; None for its entry ``success`` or ``is_success``.

    Raises:
        ArgumentError: if the teacher is of several students; at the first reset, if the environment
            has no such attribute, or more than a number there; at the first end, if the curriculum
            reads success and nothing says it.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        teacher: Teacher | TeacherClient,
        set: Mapping[str, str] | Callable[[Any, Any], object] | str,
        *,
        success: str | Callable[[Mapping[str, Any]], Any] | None = None,
    ) -> None:
        super().__init__(env)
        if teacher.students != 1 or "rollout" in teacher.reads:
            raise ArgumentError("teacher: must be of one student, and of a curriculum that is told")
        if isinstance(set, str) and set != "options":
            raise ArgumentError(f"set={set!r}: must be attributes, a function or 'options'")
        self._teacher, self._how, self._rule = teacher, set, success
        self._ticket: int | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode on the next level."""
        if self._ticket is not None:
            self._teacher.drop(self._ticket)
        self._ticket, self._level = self._teacher.ask()
        self._return, self._steps = 0.0, 0
        if callable(self._how):
            self._how(self.env.unwrapped, self._level)
        elif isinstance(self._how, str):
            options = {**(options or {}), **self._level}
        else:
            for name, path in self._how.items():
                self._set(name, path)
        if isinstance(self._level, Mapping):
            seed = _plain(self._level.get(SEED, seed))
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, self._marked(info)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """A step; the last one of an episode is told."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._return += float(reward)
        self._steps += 1
        if (terminated or truncated) and self._ticket is not None:
            info = self._marked(info)
            success = self._success({**info, "terminated": terminated, "truncated": truncated})
            self._teacher.tell(self._ticket, self._return, success, steps=self._steps)
            self._ticket = None
        return observation, reward, terminated, truncated, info

    def _set(self, name: str, path: str) -> None:
        """Set an attribute that the environment has."""
        names = [*self._level.keys()] if isinstance(self._level, Mapping) else []
        if name not in names:
            raise ArgumentError(
                f"set.{name}: no parameter; there are: {', '.join(names) or 'none'}"
            )
        env, value = self.env.unwrapped, _plain(self._level[name])
        within, _, last = path.rpartition(".")
        try:
            if isinstance(value, int | float) and not isinstance(value, bool):
                write(env, path, value)
            else:
                read(env, path)
                setattr(read(env, within) if within else env, last, value)
        except (AttributeError, AttributeRefusedError) as error:
            raise ArgumentError(f"set.{name}={path!r}: {error}") from error

    def _marked(self, info: Mapping[str, Any]) -> dict[str, Any]:
        return {**info, "level": self._level, "level_id": self._ticket}

    def _success(self, last: Mapping[str, Any]) -> Any:
        rule = self._rule
        if callable(rule):
            return rule(last)
        known = [name for name in ((rule,) if rule else SUCCESS) if name in last]
        if known:
            return last[known[0]]
        if "success" in self._teacher.reads or rule:
            raise ArgumentError(
                f"success={rule!r}: the last info has no such entry; give 'terminated', "
                "'truncated', another entry of it, or a function"
            )
        return None


def _plain(value: Any) -> Any:
    """A number as Python has it; environments take no tensors."""
    return value.item() if isinstance(value, Tensor) and value.numel() == 1 else value

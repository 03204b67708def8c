"""Curricula in TorchRL's loops: a transform that gives each episode its level."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase, Transform

from proposer_rl.settings import ArgumentError
from proposer_rl.teaching.remote import TeacherClient
from proposer_rl.teaching.segments import LEVEL_ID
from proposer_rl.teaching.teacher import Success, Teacher

NONE = -1  # the identity of no level


class LevelTransform(Transform):
    """Asks for a level at every reset, also of some environments of a batch; tells at every end.

    The number of the level that is played, its ticket, is ``level_id`` in every step. An episode
    goes to the level that it began on, in whichever rollout it ends. One that a full reset cuts off
    counts for nothing.

    It works in a collector with and without ``reset_at_each_iter``, and with ``teacher.client()``
    in environments of other processes. Put it behind transforms that end episodes and before those
    that change rewards.

    Args:
        teacher: of one student; in another process than its own, its client.
        set_level: ``set_level(env, levels)`` makes the environment, without transforms, play levels
            [*B] from its next reset on. Of those that go on the levels are as before.
        success: as of :class:`Teacher`; None for its entry ``success``.
        tell: whether it tells returns and success; False where the loop gives whole rollouts to
            :meth:`Teacher.observe`.

    Raises:
        ArgumentError: if the teacher is of several students, or reads rollouts and is to be told.
    """

    _ids: Tensor  # int64 [n], of the levels that are played
    _out: Tensor  # whether they still are, bool [n]
    _returns: Tensor
    _steps: Tensor
    _succeeded: Tensor
    _knows: bool  # whether there is such a thing

    def __init__(
        self,
        teacher: Teacher | TeacherClient,
        set_level: Callable[[EnvBase, Any], object],
        *,
        success: Success | None = None,
        tell: bool = True,
    ) -> None:
        super().__init__(in_keys=[], out_keys=[LEVEL_ID])
        if teacher.students != 1:
            raise ArgumentError(f"teacher: of {teacher.students} students, but must be of one")
        if tell and "rollout" in teacher.reads:
            raise ArgumentError(
                "tell=True: this curriculum reads rollouts; give tell=False, and each rollout to "
                "teacher.observe"
            )
        self._teacher, self._set_level = teacher, set_level
        self._rule, self._tells = success, tell
        self._levels: Any = None  # [n], in one row
        self._asked = False

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add ``level_id``."""
        shape = (*observation_spec.shape, 1)
        device = observation_spec.device
        observation_spec[LEVEL_ID] = Unbounded(shape, dtype=torch.int64, device=device)
        return observation_spec

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase | None:
        if not self._asked:  # an environment with a state comes here twice
            self._asked = True
            self._begin(tensordict)
        return tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self._asked = False
        return self._marked(tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        after = next_tensordict
        self._returns += after["reward"].reshape(-1)
        self._steps += 1
        success = self._success(after)
        self._knows = success is not None
        if success is not None:
            self._succeeded = success.reshape(-1).clone()  # it is written to
        self._end(after["done"].reshape(-1) & self._out)
        return self._marked(after)

    def _begin(self, tensordict: TensorDictBase | None) -> None:
        """Give levels to environments that are reset."""
        env = self.parent.base_env
        count = env.batch_size.numel()
        device = env.device or torch.device("cpu")
        key = env.reset_keys[0]
        mask = None if tensordict is None else tensordict.get(key, None)
        if mask is None or self._levels is None:
            self._start(count, device)
            which = torch.arange(count, device=device)
        else:
            # What has not ended here ended by a transform behind this one.
            self._end(mask.reshape(-1) & self._out)
            which = mask.reshape(-1).nonzero().squeeze(-1)
        ids, levels = self._teacher.ask(len(which))
        levels = levels.to(device)
        if self._levels is None:
            self._levels = levels.clone()
        self._levels[which] = levels
        self._ids[which], self._out[which] = ids.to(device), True
        self._returns[which], self._steps[which], self._succeeded[which] = 0, 0, False
        batch = env.batch_size
        played = self._levels.unflatten(0, batch) if batch else self._levels[0]
        self._set_level(env, played.clone())

    def _start(self, count: int, device: torch.device) -> None:
        if self._levels is not None and bool(self._out.any()):
            self._teacher.drop(self._ids[self._out])
        self._ids = torch.full((count,), NONE, device=device)
        self._returns = torch.zeros(count, dtype=torch.float64, device=device)
        self._steps = torch.zeros(count, dtype=torch.int64, device=device)
        self._out = torch.zeros(count, dtype=torch.bool, device=device)
        self._succeeded = torch.zeros_like(self._out)

    def _end(self, ended: Tensor) -> None:
        """Tell what came of episodes, bool [n]."""
        which = ended.nonzero().squeeze(-1)  # waits for the device once, where each mask would
        if self._tells and len(which):
            self._teacher.tell(
                self._ids[which],
                self._returns[which],
                self._succeeded[which] if self._knows else None,
                steps=self._steps[which],
            )
        self._out = self._out & ~ended

    def _success(self, after: TensorDictBase) -> Tensor | None:
        rule = self._rule
        if rule is not None:
            return rule(after) if callable(rule) else after[rule]
        if "success" in after.keys():
            return after["success"]
        if "success" in self._teacher.reads:
            raise ArgumentError(
                "success: missing: this curriculum reads it, and the environment has no such "
                'entry; give success="terminated", "truncated" or a function'
            )
        return None

    def _marked(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set(LEVEL_ID, self._ids.reshape(*tensordict.batch_size, 1).clone())

"""Curricula in TorchRL's loops: a transform that gives each episode its level."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import AutoResetTransform, EnvBase, Transform, VecGymEnvTransform

from proposer_rl.settings import ArgumentError
from proposer_rl.teaching.remote import TeacherClient
from proposer_rl.teaching.segments import LEVEL_ID
from proposer_rl.teaching.teacher import Success, Teacher

NONE = -1  # the identity of no level


class _Played:
    """The levels [n] that the environments of a batch play, and what has come of them so far."""

    ids: Tensor  # int64 [n]
    out: Tensor  # whether they still are, bool [n]
    returns: Tensor
    steps: Tensor
    succeeded: Tensor
    knows: bool  # whether there is such a thing
    levels: Any = None  # [n], in one row
    asked = False


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

    @property
    def _now(self) -> _Played:
        # The environment's: of a transform that another one steps through TorchRL makes a clone.
        played: dict[int, _Played] = vars(self.parent.base_env).setdefault("_played", {})
        return played.setdefault(id(self._teacher), _Played())

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add ``level_id``."""
        shape = (*observation_spec.shape, 1)
        device = observation_spec.device
        observation_spec[LEVEL_ID] = Unbounded(shape, dtype=torch.int64, device=device)
        return observation_spec

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase | None:
        now = self._now
        if not now.asked:  # an environment with a state comes here twice
            now.asked = True
            self._begin(tensordict)
        return tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self._now.asked = False
        return self._marked(tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        after, now = next_tensordict, self._now
        now.returns += after["reward"].reshape(-1)
        now.steps += 1
        success = self._success(after)
        now.knows = success is not None
        if success is not None:
            now.succeeded = success.reshape(-1).clone()  # it is written to
        self._end(after["done"].reshape(-1) & now.out)
        return self._marked(after)

    def _begin(self, tensordict: TensorDictBase | None) -> None:
        """Give levels to environments that are reset."""
        env, now = self.parent.base_env, self._now
        count = env.batch_size.numel()
        device = env.device or torch.device("cpu")
        key = env.reset_keys[0]
        mask = None if tensordict is None else tensordict.get(key, None)
        if mask is None or now.levels is None:
            self._start(count, device)
            which = torch.arange(count, device=device)
        else:
            # What has not ended here ended by a transform behind this one.
            self._end(mask.reshape(-1) & now.out)
            which = mask.reshape(-1).nonzero().squeeze(-1)
        ids, levels = self._teacher.ask(len(which))
        levels = levels.to(device)
        if now.levels is None:
            now.levels = levels.clone()
        now.levels[which] = levels
        now.ids[which], now.out[which] = ids.to(device), True
        now.returns[which], now.steps[which], now.succeeded[which] = 0, 0, False
        batch = env.batch_size
        played = now.levels.unflatten(0, batch) if batch else now.levels[0]
        self._set_level(env, played.clone())

    def _start(self, count: int, device: torch.device) -> None:
        now = self._now
        resets_itself = VecGymEnvTransform, AutoResetTransform
        if any(isinstance(part, resets_itself) for part in self.parent.modules()):
            raise ArgumentError(
                "env: resets itself at an episode's end, before there is another level; give a "
                "vector of Gymnasium autoreset_mode=AutoresetMode.DISABLED"
            )
        if now.levels is not None and bool(now.out.any()):
            self._teacher.drop(now.ids[now.out])
        now.ids = torch.full((count,), NONE, device=device)
        now.returns = torch.zeros(count, dtype=torch.float64, device=device)
        now.steps = torch.zeros(count, dtype=torch.int64, device=device)
        now.out = torch.zeros(count, dtype=torch.bool, device=device)
        now.succeeded = torch.zeros_like(now.out)

    def _end(self, ended: Tensor) -> None:
        """Tell what came of episodes, bool [n]."""
        now = self._now
        which = ended.nonzero().squeeze(-1)  # waits for the device once, where each mask would
        if self._tells and len(which):
            self._teacher.tell(
                now.ids[which],
                now.returns[which],
                now.succeeded[which] if now.knows else None,
                steps=now.steps[which],
            )
        now.out = now.out & ~ended

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
        return tensordict.set(LEVEL_ID, self._now.ids.reshape(*tensordict.batch_size, 1).clone())

"""Curricula in TorchRL's loops: a transform that gives each episode its level."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import (
    AutoResetTransform,
    EnvBase,
    ParallelEnv,
    SerialEnv,
    Transform,
    VecGymEnvTransform,
)

from proposer_rl.settings import ArgumentError
from proposer_rl.teaching.remote import TeacherClient
from proposer_rl.teaching.results import LEVEL_ID
from proposer_rl.teaching.teacher import Success, Teacher

NONE = -1  # the ticket of no level


class _Played:
    """The levels [n] that the environments of a batch play, and their results so far."""

    owners: Sequence[object] = ()  # of the transforms that there were, the present one last
    ids: Tensor  # int64 [n]
    out: Tensor  # whether an episode on the level goes on, bool [n]
    returns: Tensor
    steps: Tensor
    succeeded: Tensor
    knows: bool  # whether anything says what a success is
    levels: Any = None  # [n], without the batch's other dimensions
    asked = False

    def __reduce__(self) -> Any:
        return _Played, ()  # a copy in another process plays nothing yet


class LevelTransform(Transform):
    """Asks a teacher for a level at every reset, and tells it the result of every episode.

    Some environments of a batch may be reset while others go on. ``level_id``, in every step, is
    the ticket of the level that is played: an episode counts for the level that it began on, in
    whichever rollout it ends. An episode that a full reset cuts off is dropped.

    An environment has one ``LevelTransform``: a second one around it is refused, and a new one
    around its ``base_env`` replaces the first.

    It works in collectors with and without ``reset_at_each_iter``, and with ``teacher.client()``
    in environments of other processes. Put it behind transforms that end episodes and before those
    that change rewards.

    Args:
        teacher: the teacher, or in another process its client.
        set_level: ``set_level(env, levels)`` makes the environment, without transforms, play levels
            [*B] from its next reset on; for environments that are not reset they are as before.
        success: as of :class:`Teacher`, or another entry of ``next``; None for its entry
            ``success``, or the ``success_rule`` of the environment's class.
        once: whether an episode is a success if any of its steps was, not only the last.
        reward: the entry of ``next`` that returns are sums of, a number for each environment; or a
            function of ``next`` that makes one of the rewards of several agents or objectives.
        tell: whether it tells return and success; False where the loop gives whole rollouts to
            :meth:`Teacher.observe`. A collector with ``set_truncated``, which ends episodes only
            in the rollout, then needs ``reset_at_each_iter``.

    Raises:
        ArgumentError: at the first reset, if the environment has a ``LevelTransform``, resets
            itself, or is a ``ParallelEnv`` or ``SerialEnv``; later, if another one has replaced it.
    """

    def __init__(
        self,
        teacher: Teacher | TeacherClient,
        set_level: Callable[[EnvBase, Any], object],
        *,
        success: Success | NestedKey | None = None,
        once: bool = False,
        reward: NestedKey | Callable[[TensorDictBase], Tensor] = "reward",
        tell: bool = True,
    ) -> None:
        super().__init__(in_keys=[], out_keys=[LEVEL_ID])
        self._teacher, self._set_level, self._own = teacher, set_level, object()
        self._rule, self._once, self._reward, self._tells = success, once, reward, tell

    @property
    def _now(self) -> _Played:
        # Kept by the environment, since TorchRL clones transforms that another one steps through.
        place = vars(self.parent.base_env)
        played: _Played = place.get("_played", _Played())
        if self._own not in played.owners[-1:]:
            if LEVEL_ID in self.parent.observation_spec.keys() or self._own in played.owners:
                raise ArgumentError(
                    "env: has another LevelTransform, as happens when a cell is run twice; make "
                    "the environment anew, or wrap env.base_env and use only the new one"
                )
            before, played = played, _Played()
            played.owners = [*before.owners, self._own]
            place["_played"] = played
        return played

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds ``level_id``."""
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
        now.returns += self._of_each(self._reward, after)
        now.steps += 1
        rule = self._rule
        if rule is None:
            own_rule = getattr(type(self.parent.base_env), "success_rule", None)
            rule = "success" if "success" in after.keys() else own_rule
        now.knows = rule is not None
        if rule is not None:
            success = self._of_each(rule, after)
            # A copy, as resets write to it.
            now.succeeded = now.succeeded.maximum(success) if self._once else success.clone()
        self._end(self._of_each("done", after) & now.out)
        return self._marked(after)

    def _begin(self, tensordict: TensorDictBase | None) -> None:
        """Gives levels to environments that are reset."""
        env, now = self.parent.base_env, self._now
        count = env.batch_size.numel()
        device = env.device or torch.device("cpu")
        key = env.reset_keys[0]
        mask = None if tensordict is None else tensordict.get(key, None)
        if mask is None or now.levels is None:
            self._start(count, device)
            which = torch.arange(count, device=device)
        else:
            # Episodes that have not ended here were ended by a transform behind this one.
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
        now, env = self._now, self.parent.base_env
        if isinstance(env, ParallelEnv | SerialEnv):
            name = type(env).__name__
            raise ArgumentError(
                f"env: set_level cannot reach the environments inside {name}; give each its own "
                f"transform, as in {name}(n, make), where make returns TransformedEnv(env, "
                "LevelTransform(client, set_level)) with client = teacher.client()"
            )
        resets_itself = VecGymEnvTransform, AutoResetTransform
        if any(isinstance(part, resets_itself) for part in self.parent.modules()):
            raise ArgumentError(
                "env: resets itself at the end of an episode, before the next level is set; make "
                "a vector environment with autoreset_mode=AutoresetMode.DISABLED"
            )
        if now.levels is not None and bool(now.out.any()):
            self._teacher.drop(now.ids[now.out])
        now.ids = torch.full((count,), NONE, device=device)
        now.returns = torch.zeros(count, dtype=torch.float64, device=device)
        now.steps = torch.zeros(count, dtype=torch.int64, device=device)
        now.out = torch.zeros(count, dtype=torch.bool, device=device)
        now.succeeded = torch.zeros_like(now.out)

    def _end(self, ended: Tensor) -> None:
        """Tells the results of the environments whose episodes have ended, bool [n]."""
        now = self._now
        which = ended.nonzero().squeeze(-1)  # waits for the device once, not for every mask
        if self._tells and len(which):
            self._teacher.tell(
                now.ids[which],
                now.returns[which],
                now.succeeded[which] if now.knows else None,
                steps=now.steps[which],
            )
        now.out = now.out & ~ended

    def _of_each(self, rule: Any, after: TensorDictBase) -> Tensor:
        """Returns a number for each environment, [n], by an entry or a function of ``next``."""
        entry: Tensor = rule(after) if callable(rule) else after[rule]
        return entry.reshape(self.parent.batch_size.numel())

    def _marked(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set(LEVEL_ID, self._now.ids.reshape(*tensordict.batch_size, 1).clone())

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

NONE = -1  # the identity of no level


class _Played:
    """The levels [n] that the environments of a batch play, and what has come of them so far."""

    owners: Sequence[object] = ()  # those of the transforms there were, the present one last
    ids: Tensor  # int64 [n]
    out: Tensor  # whether they still are, bool [n]
    returns: Tensor
    steps: Tensor
    succeeded: Tensor
    knows: bool  # whether there is such a thing
    levels: Any = None  # [n], in one row
    asked = False

    def __reduce__(self) -> Any:
        return _Played, ()  # a copy in another process plays nothing yet


class LevelTransform(Transform):
    """Asks a teacher for a level at every reset, and reports every episode.

    Resets may be of some environments of a batch. ``level_id``, in every step, is the ticket of the
    level that is played. An episode goes to the level that it began on, in whichever rollout it
    ends. One that a full reset cuts off counts for nothing.

    An environment has one ``LevelTransform``: a second one around it is refused, and one around its
    ``base_env`` takes the place of the first.

    It works in a collector with and without ``reset_at_each_iter``, and with ``teacher.client()``
    in environments of other processes. Put it behind transforms that end episodes and before those
    that change rewards.

    Args:
        teacher: in another process than its own, its client.
        set_level: ``set_level(env, levels)`` makes the environment, without transforms, play levels
            [*B] from its next reset on. Of those that go on the levels are as before.
        success: see :class:`Teacher`, or another entry of ``next``; None for its entry
            ``success``, or what the environment's class has as ``success_rule``.
        once: whether it may be one in any step, so that what is reached and lost again counts.
        reward: the entry of ``next`` that returns are of, one number for each environment; or a
            function of ``next`` that makes it of several agents' or objectives'.
        tell: whether it reports returns and success; False where the loop gives whole rollouts to
            :meth:`Teacher.observe`. A collector with ``set_truncated``, which ends episodes in a
            rollout alone, then needs ``reset_at_each_iter``.

    Raises:
        ArgumentError: if the teacher reads rollouts while ``tell`` is true; at the first reset, if
            the environment has a ``LevelTransform`` or no such reward or success, resets itself, or
            is one of several that levels do not get into from outside; later, if another
            ``LevelTransform`` has taken this one's place.
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
        if tell and "rollout" in teacher.required_results:
            raise ArgumentError(
                "tell=True: this curriculum reads rollouts; give tell=False, and each rollout to "
                "teacher.observe"
            )
        self._teacher, self._set_level, self._own = teacher, set_level, object()
        self._rule, self._once, self._reward, self._tells = success, once, reward, tell

    @property
    def _now(self) -> _Played:
        # The environment's: of a transform that another one steps through TorchRL makes a clone.
        place = vars(self.parent.base_env)
        played: _Played = place.get("_played", _Played())
        if self._own not in played.owners[-1:]:
            if LEVEL_ID in self.parent.observation_spec.keys():
                raise ArgumentError(
                    "env: has a LevelTransform already, as where a cell is run twice: each would "
                    "set a level of its own; make the environment anew, or give env.base_env"
                )
            if self._own in played.owners:
                raise ArgumentError(
                    "env: another LevelTransform has been put around it since; use that"
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
        now.returns += self._of_each("reward", self._reward, after)
        now.steps += 1
        rule = self._success(after)
        now.knows = rule is not None
        if rule is not None:
            success = self._of_each("success", rule, after)
            # It is written to.
            now.succeeded = now.succeeded.maximum(success) if self._once else success.clone()
        self._end(self._of_each("done", "done", after) & now.out)
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
        now, env = self._now, self.parent.base_env
        if isinstance(env, ParallelEnv | SerialEnv):
            name = type(env).__name__
            raise ArgumentError(
                f"env: levels do not get into the environments of {name} from outside; give each "
                f"a transform, as in {name}(n, make), where make returns TransformedEnv(env, "
                "LevelTransform(client, set_level)) with client = teacher.client()"
            )
        resets_itself = VecGymEnvTransform, AutoResetTransform
        if any(isinstance(part, resets_itself) for part in self.parent.modules()):
            raise ArgumentError(
                "env: resets itself at an episode's end, before there is another level; give a "
                "vector of Gymnasium autoreset_mode=AutoresetMode.DISABLED"
            )
        if now.levels is None:
            self._check()
        elif bool(now.out.any()):
            self._teacher.drop(now.ids[now.out])
        now.ids = torch.full((count,), NONE, device=device)
        now.returns = torch.zeros(count, dtype=torch.float64, device=device)
        now.steps = torch.zeros(count, dtype=torch.int64, device=device)
        now.out = torch.zeros(count, dtype=torch.bool, device=device)
        now.succeeded = torch.zeros_like(now.out)

    def _check(self) -> None:
        """Refuses what a step will lack, before there is one."""
        after = self.parent.fake_tensordict()["next"]
        self._of_each("done", "done", after)
        for name, rule in (("reward", self._reward), ("success", self._success(after))):
            if rule is not None and not callable(rule):
                self._of_each(name, rule, after)

    def _end(self, ended: Tensor) -> None:
        """Reports the episodes of the environments where one has ended, bool [n]."""
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

    def _of_each(self, name: str, rule: Any, after: TensorDictBase) -> Tensor:
        """Returns one number of each environment, [n], by an entry or a function."""
        entry = rule(after) if callable(rule) else after[rule]
        batch = self.parent.batch_size
        if entry.numel() != batch.numel() or entry.shape[: len(batch)] != batch:
            raise ArgumentError(
                f"{name}: has the shape {[*entry.shape]}, not {[*batch, 1]}; it must be "
                "one number for each environment, an entry or a function of next"
            )
        return entry.reshape(-1)

    def _success(self, after: TensorDictBase) -> Any:
        """Returns the entry or function that says what is a success; None where nothing does."""
        if self._rule is not None:
            return self._rule
        if "success" in after.keys():
            return "success"
        rule = getattr(type(self.parent.base_env), "success_rule", None)
        if rule is None and self._tells and "success" in self._teacher.required_results:
            raise ArgumentError(
                "success: missing: this curriculum reads it, and the environment has no such "
                'entry; give success="terminated", "truncated" or a function'
            )
        return rule

    def _marked(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set(LEVEL_ID, self._now.ids.reshape(*tensordict.batch_size, 1).clone())

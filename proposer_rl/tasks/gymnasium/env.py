"""Environments of Gymnasium as one TorchRL environment, each on a level of its own."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Categorical, Composite, MultiCategorical, Unbounded
from torchrl.envs import EnvBase

from proposer_rl.models import available_cores, callers_state
from proposer_rl.tasks.gymnasium.answers import UnfitEnvironmentError
from proposer_rl.tasks.gymnasium.player import LevelPlayer, MakeEnvironment, Play
from proposer_rl.tasks.gymnasium.processes import ProcessVectorEnv
from proposer_rl.tasks.gymnasium.settings import ParameterSettings, SuccessSettings
from proposer_rl.tasks.gymnasium.spaces import NUMBERS
from proposer_rl.tasks.parameters import SEED

Vectorization = Literal["sync", "async"]
FLAGS = ("success", "is_init")  # entries that no Solver sees


class GymnasiumEnv(EnvBase):
    """A batch of environments of Gymnasium, stepped by its vector environments.

    An environment whose episode is over begins its level again, from the same seed. Observations
    are those of :func:`~proposer_rl.tasks.gymnasium.spaces.plain`, ``observation`` and perhaps
    images; ``success``, bool [*B, 1], whether the step ended an episode that counts as one; and
    ``is_init``, bool [*B, 1], whether the step begins one. ``reward`` is scaled.

    Args:
        levels: as :class:`~proposer_rl.tasks.parameters.ParameterSpace` makes them, [*B]. Their
            device is that of the states.
        make: makes one environment.
        parameters: what differs between levels, by name.
        success: when an episode is one.
        reward_scale: rewards are multiplied with it.
        vectorization: one after another, or in as many processes as there are cores.
        once: play one episode of each level, and then stand still, without reward.
    """

    def __init__(
        self,
        levels: TensorDictBase,
        make: MakeEnvironment,
        parameters: Mapping[str, ParameterSettings],
        *,
        success: SuccessSettings,
        reward_scale: float = 1.0,
        vectorization: Vectorization = "sync",
        once: bool = False,
    ) -> None:
        super().__init__(device=levels.device or "cpu", batch_size=levels.batch_size)
        self._reward_scale = reward_scale
        self._plays = plays(levels)
        players = [
            partial(LevelPlayer, make, parameters, play, success, once) for play in self._plays
        ]
        self._vector: SyncVectorEnv | ProcessVectorEnv
        with callers_state():  # as wherever code of theirs runs
            if vectorization == "sync":
                self._vector = SyncVectorEnv(players, autoreset_mode=AutoresetMode.DISABLED)
            else:
                self._vector = ProcessVectorEnv(players, available_cores())
        self._make_specs()

    def set_levels(self, levels: TensorDictBase) -> None:
        """Play these levels [*B] from the next reset on."""
        self._plays = plays(levels)
        self._vector.set_attr("play", self._plays)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close all environments, and end their processes."""
        with callers_state():
            self._vector.close()
        super().close(raise_if_closed=raise_if_closed)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDict:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        options = None if mask is None else {"reset_mask": mask.reshape(-1).cpu().numpy()}
        with callers_state():
            seen, _ = self._vector.reset(options=options)
        # Of these TorchRL takes over only the entries of the environments that are reset.
        none = np.zeros(self._vector.num_envs, np.bool_)
        return self._batched(seen, success=none, is_init=~none)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        space = self._vector.single_action_space
        actions = as_actions(tensordict["action"].flatten(0, self.batch_dims - 1), space)
        with callers_state():
            seen, rewards, terminated, truncated, info = self._vector.step(actions)
        none = np.zeros_like(terminated)
        return self._batched(
            seen,
            success=info.get("success", none),
            is_init=none,
            reward=self._finite("reward", rewards * self._reward_scale),
            terminated=terminated,
            truncated=truncated,
            done=terminated | truncated,
        )

    def _batched(self, seen: Any, **entries: NDArray[Any]) -> TensorDict:
        """Entries [n, ...] of all environments, [*B, ...]; single numbers as [*B, 1]."""
        observed = seen if isinstance(seen, dict) else {NUMBERS: seen}
        numbers = {key: self._finite(key, entry) for key, entry in observed.items()}
        tensors = {
            key: torch.as_tensor(entry).reshape(*self.batch_size, *(entry.shape[1:] or (1,)))
            for key, entry in {**numbers, **entries}.items()
        }
        return TensorDict(tensors, self.batch_size).to(self.device)

    def _finite(self, name: str, entry: NDArray[Any]) -> NDArray[Any]:
        """Numbers [n, ...] as float32; bytes as they are.

        Raises:
            UnfitEnvironmentError: for one that is not finite, naming the level.
        """
        if entry.dtype == np.uint8:
            return entry
        numbers = entry.astype(np.float32, copy=False)
        finite = np.isfinite(numbers)
        if not finite.all():
            first = int(finite.reshape(len(finite), -1).all(-1).argmin())
            raise UnfitEnvironmentError(
                f"{name}: NaN or infinity, or a number beyond float32, on the level "
                f"{self._plays[first]}"
            )
        return numbers

    def _make_specs(self) -> None:
        batch = self.batch_size
        acts = self._vector.single_action_space
        seen = self._vector.single_observation_space
        boxes = seen.spaces if isinstance(seen, spaces.Dict) else {NUMBERS: seen}
        observed = {
            name: Unbounded(
                (*batch, *(box.shape or ())),
                dtype=torch.uint8 if box.dtype == np.uint8 else torch.float32,
            )
            for name, box in boxes.items()
        }
        flag = Binary(1, (*batch, 1), dtype=torch.bool)
        flags = {name: flag.clone() for name in FLAGS}
        self.observation_spec = Composite({**observed, **flags}, shape=batch).to(self.device)
        if isinstance(acts, spaces.Discrete):
            self.action_spec = Categorical(int(acts.n), shape=batch)
        elif isinstance(acts, spaces.MultiDiscrete):
            options = torch.as_tensor(acts.nvec)
            self.action_spec = MultiCategorical(options, (*batch, len(options)))
        else:
            self.action_spec = Unbounded((*batch, *(acts.shape or ())))
        self.action_spec = self.action_spec.to(self.device)
        self.reward_spec = Unbounded((*batch, 1), device=self.device)
        ends = {key: flag.clone() for key in ("done", "terminated", "truncated")}
        self.done_spec = Composite(ends, shape=batch).to(self.device)

    def _set_seed(self, seed: int | None) -> None:
        """Do nothing: what is random belongs to the levels."""


def plays(levels: TensorDictBase) -> list[Play]:
    """What players are to play for levels [*B], in one row."""
    columns = {str(name): entry.flatten().tolist() for name, entry in levels.items()}
    seeds = columns.pop(SEED)
    return [
        Play(dict(zip(columns, row, strict=True)), seed)
        for seed, *row in zip(seeds, *columns.values(), strict=True)
    ]


def as_actions(actions: Tensor, space: spaces.Space[Any]) -> NDArray[Any]:
    """Actions [n, ...] of a policy as environments of a space take them."""
    taken = actions.cpu().numpy()
    return taken + space.start if isinstance(space, spaces.Discrete) else taken

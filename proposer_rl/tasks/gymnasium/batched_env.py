"""Steps a batch of Gymnasium environments, each on its own level, as one TorchRL environment."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Mapping
from functools import partial
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase

from proposer_rl.models import check_torch_defaults
from proposer_rl.tasks.gymnasium.environment import SuccessSettings, UnfitEnvironmentError
from proposer_rl.tasks.gymnasium.player import (
    GymLevel,
    LevelPlayer,
    MakeEnvironment,
    ParameterSettings,
)
from proposer_rl.tasks.gymnasium.spaces import Layout, in_order
from proposer_rl.tasks.parameters import SEED

Vectorization = Literal["sync", "async"]
FLAGS = ("success", "is_init")  # entries that Solvers do not see
# A fork of this process would inherit locks that its other threads hold, such as torch's, and wait
# for them forever. The fork server has no threads, and imports torch once for all processes.
START = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"


class GymnasiumEnv(EnvBase):
    """A batch of Gymnasium environments, stepped by Gymnasium's vector environments.

    After an episode an environment begins its level again, from the same seed. Observations are
    those of a :class:`~proposer_rl.tasks.gymnasium.spaces.Layout`: ``observation``, and perhaps
    images. ``success``, bool [*B, 1], is whether a step ended a successful episode, and
    ``is_init``, bool [*B, 1], whether a state begins an episode.

    Args:
        levels: of a :class:`~proposer_rl.tasks.parameters.ParameterSpace`, [*B]; states are on
            their device.
        make: makes one environment.
        parameters: what differs between levels, by name.
        success: when an episode is a success.
        vectorization: ``"sync"`` steps one after another, ``"async"`` each in a process of its
            own.
        once: whether to play one episode of each level and then stand still, without reward.
    """

    def __init__(
        self,
        levels: TensorDictBase,
        make: MakeEnvironment,
        parameters: Mapping[str, ParameterSettings],
        *,
        success: SuccessSettings,
        vectorization: Vectorization = "sync",
        once: bool = False,
    ) -> None:
        check_torch_defaults()
        super().__init__(device=levels.device or "cpu", batch_size=levels.batch_size)
        self._parameters = parameters
        self._plays = plays(levels, parameters)
        registered = gymnasium.registry.get(make.env_id)
        players = [
            partial(_player, os.getpid(), registered, make, parameters, play, success, once)
            for play in self._plays
        ]
        self._vector: SyncVectorEnv | AsyncVectorEnv
        if vectorization == "sync":
            self._vector = SyncVectorEnv(players, autoreset_mode=AutoresetMode.DISABLED)
        else:
            if START == "forkserver":
                multiprocessing.get_context(START).set_forkserver_preload([__name__])
            self._vector = AsyncVectorEnv(
                players, context=START, autoreset_mode=AutoresetMode.DISABLED
            )
        acts = self._vector.single_action_space
        self._layout = Layout(self._vector.single_observation_space, acts)
        self._make_specs()

    def set_levels(self, levels: TensorDictBase) -> None:
        """Sets the levels [*B] that are played from the next reset on."""
        self._plays = plays(levels, self._parameters)
        self._vector.set_attr("play", self._plays)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Closes all environments, and ends their processes."""
        self._vector.close(terminate=True)  # which SyncVectorEnv ignores
        super().close(raise_if_closed=raise_if_closed)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDict:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        options = None if mask is None else {"reset_mask": mask.reshape(-1).cpu().numpy()}
        seen, _ = self._vector.reset(options=options)
        # TorchRL takes these entries only for the environments that are reset.
        none = np.zeros(self._vector.num_envs, np.bool_)
        return self._batched(seen, success=none, is_init=~none)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        actions = self._layout.taken(tensordict["action"].flatten(0, self.batch_dims - 1))
        seen, rewards, terminated, truncated, info = self._vector.step(actions)
        none = np.zeros_like(terminated)
        return self._batched(
            seen,
            success=info.get("success", none),
            is_init=none,
            reward=rewards,
            terminated=terminated,
            truncated=truncated,
            done=terminated | truncated,
        )

    def _batched(self, seen: Any, **entries: NDArray[Any]) -> TensorDict:
        """Returns entries [n, ...] as [*B, ...], single numbers as [*B, 1].

        Raises:
            UnfitEnvironmentError: naming the level, if a number is not finite as float32.
        """
        shown = map(torch.as_tensor, in_order(self._layout.observation_space, seen))
        found = self._layout.entries(shown)
        for key, entry in entries.items():
            one = torch.as_tensor(entry).unsqueeze(-1)
            found[key] = one.float() if one.is_floating_point() else one
        for key, one in found.items():
            if one.is_floating_point() and not one.isfinite().all():
                first = int(one.isfinite().flatten(1).all(-1).int().argmin())
                raise UnfitEnvironmentError(
                    f"{key}: NaN or infinity, or a number beyond float32, on the level "
                    f"{self._plays[first]}"
                )
        tensors = {key: one.reshape(*self.batch_size, *one.shape[1:]) for key, one in found.items()}
        return TensorDict(tensors, self.batch_size).to(self.device)

    def _make_specs(self) -> None:
        batch = self.batch_size
        seen = {name: spec.expand(*batch, *spec.shape) for name, spec in self._layout.seen.items()}
        flag = Binary(1, (*batch, 1), dtype=torch.bool)
        flags = {name: flag.clone() for name in FLAGS}
        self.observation_spec = Composite({**seen, **flags}, shape=batch).to(self.device)
        self.action_spec = self._layout.acts.expand(*batch, *self._layout.acts.shape).to(
            self.device
        )
        self.reward_spec = Unbounded((*batch, 1), device=self.device)
        ends = {key: flag.clone() for key in ("done", "terminated", "truncated")}
        self.done_spec = Composite(ends, shape=batch).to(self.device)

    def _set_seed(self, seed: int | None) -> None:
        """Does nothing: random numbers come from the levels' seeds."""


def plays(levels: TensorDictBase, parameters: Mapping[str, ParameterSettings]) -> list[GymLevel]:
    """Returns levels [*B] of a parameter space as a flat list for players."""
    rows = levels.reshape(-1)
    columns = [given.space_bins().named(rows[name]) for name, given in parameters.items()]
    return [
        GymLevel(dict(zip(parameters, row, strict=True)), seed)
        for seed, *row in zip(rows[SEED].tolist(), *columns, strict=True)
    ]


def _player(
    home: int, registered: gymnasium.envs.registration.EnvSpec | None, *given: Any
) -> LevelPlayer:
    """Returns the environment that plays a level, in a process of its own or in the run's, home."""
    if os.getpid() != home:
        # These ask the run to stop, which saves its work first; this process ends with it.
        for name in ("SIGINT", "SIGHUP", "SIGUSR1", "SIGUSR2"):
            if hasattr(signal, name):  # Windows has the first alone
                signal.signal(getattr(signal, name), signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        torch.set_num_threads(1)
    if registered is not None:
        gymnasium.registry.setdefault(registered.id, registered)
    return LevelPlayer(*given)

"""Steps a batch of Gymnasium environments, each on its own level, as one TorchRL environment."""

from __future__ import annotations

import multiprocessing
import pickle
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import Connection
from threading import Lock
from types import ModuleType
from typing import Any, Literal

import cloudpickle
import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch.utils._pytree import tree_map
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase

from proposer_rl.models import available_cores, check_torch_defaults
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
_FORKSERVER = "forkserver" in multiprocessing.get_all_start_methods()  # not on Windows
CONTEXT: Any = multiprocessing.get_context("forkserver" if _FORKSERVER else "spawn")
GRACE = 10.0  # seconds that a process has to end
_STARTING = Lock()


class GymnasiumEnv(EnvBase):
    """A batch of Gymnasium environments, stepped by Gymnasium's vector environments.

    After an episode an environment begins its level again, from the same seed. Observations are
    those of a :class:`~proposer_rl.tasks.gymnasium.spaces.Layout`: ``observation``, and perhaps
    images. ``success``, bool [*B, 1], is whether a step ended a successful episode, and
    ``is_init``, bool [*B, 1], whether a state begins an episode. ``reward`` is scaled.

    Args:
        levels: of a :class:`~proposer_rl.tasks.parameters.ParameterSpace`, [*B]; states are on
            their device.
        make: makes one environment.
        parameters: what differs between levels, by name.
        success: when an episode is a success.
        reward_scale: factor of the rewards.
        vectorization: ``"sync"`` steps one after another, ``"async"`` in as many processes as
            there are cores.
        once: whether to play one episode of each level and then stand still, without reward.
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
        check_torch_defaults()
        super().__init__(device=levels.device or "cpu", batch_size=levels.batch_size)
        self._reward_scale = reward_scale
        self._parameters = parameters
        self._plays = plays(levels, parameters)
        registered = gymnasium.registry.get(make.env_id)
        players = [
            partial(_player, registered, make, parameters, play, success, once)
            for play in self._plays
        ]
        self._vector: SyncVectorEnv | ProcessVectorEnv
        if vectorization == "sync":
            self._vector = SyncVectorEnv(players, autoreset_mode=AutoresetMode.DISABLED)
        else:
            self._vector = ProcessVectorEnv(players, available_cores())
        acts = self._vector.single_action_space
        self._layout = Layout(self._vector.single_observation_space, acts)
        self._make_specs()

    def set_levels(self, levels: TensorDictBase) -> None:
        """Sets the levels [*B] that are played from the next reset on."""
        self._plays = plays(levels, self._parameters)
        self._vector.set_attr("play", self._plays)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Closes all environments, and ends their processes."""
        self._vector.close()
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
            reward=rewards * self._reward_scale,
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


class LostProcessError(RuntimeError):
    """A process that steps environments has ended; the message is one line."""

    exit_code = 6


class ProcessVectorEnv:
    """Steps environments in several processes, as Gymnasium's vector environments do in one.

    The number of processes does not change what an environment does.

    Args:
        makes: functions that make the environments.
        count: processes, of which there are at most as many as environments.

    Attributes:
        num_envs: number n of environments.
        single_observation_space, single_action_space: of each environment.
        processes: that step them.
    """

    def __init__(self, makes: Sequence[Callable[[], Any]], count: int) -> None:
        self.num_envs = len(makes)
        self._parts = np.array_split(np.arange(len(makes)), min(count, len(makes)))
        self._pipes: list[Connection] = []
        self.processes = []
        if _FORKSERVER:
            CONTEXT.set_forkserver_preload([__name__])
        for _ in self._parts:
            ours, theirs = CONTEXT.Pipe()
            process = CONTEXT.Process(target=_serve, args=(theirs,), daemon=True)
            with _without_script():
                process.start()
            theirs.close()
            self._pipes.append(ours)
            self.processes.append(process)
        # Cloudpickle also sends classes and functions of a script.
        vectors = [
            partial(SyncVectorEnv, [makes[i] for i in part], autoreset_mode=AutoresetMode.DISABLED)
            for part in self._parts
        ]
        found = self._ask("make", [(cloudpickle.dumps(vector),) for vector in vectors])
        self.single_observation_space: spaces.Space[Any] = found[0][0]
        self.single_action_space: spaces.Space[Any] = found[0][1]

    def reset(self, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begins episodes in all environments, or in those of the ``reset_mask``, bool [n]."""
        parts = [(options and {"reset_mask": options["reset_mask"][part]},) for part in self._parts]
        return _joined(self._ask("reset", parts)), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Takes a step in each environment, with actions [n, ...]."""
        shares = [tree_map(lambda rows, part=part: rows[part], actions) for part in self._parts]
        answer: Any = _joined(self._ask("step", [(share,) for share in shares]))
        return answer

    def set_attr(self, name: str, values: Sequence[Any]) -> None:
        """Sets an attribute of each environment to a value of its own."""
        self._ask("set_attr", [(name, [values[i] for i in part]) for part in self._parts])

    def close(self) -> None:
        """Ends the processes, and kills those that do not end within ten seconds."""
        for pipe in self._pipes:
            pipe.close()
        for process in self.processes:
            process.join(GRACE)
            if process.is_alive():
                process.kill()
                process.join(GRACE)

    def _ask(self, what: str, arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Calls a method in all processes at the same time, and returns their answers.

        Raises:
            Exception: of the first environment that fails.
            LostProcessError: if a process has ended.
        """
        try:
            for pipe, given in zip(self._pipes, arguments, strict=True):
                pipe.send((what, given))
            answers = [pipe.recv() for pipe in self._pipes]
        except (EOFError, OSError) as error:
            for process in self.processes:
                process.join(1)
            codes = [process.exitcode for process in self.processes if process.exitcode]
            raise LostProcessError(
                f"vectorization=async: a process of the environments was lost (exit code {codes}; "
                "-9 mostly means that memory ran out)"
            ) from error
        for failed, answer in answers:
            if failed:
                raise answer
        return [answer for _, answer in answers]


def _joined(answers: list[Any]) -> Any:
    """Returns the arrays in the answers of all processes, joined in their places."""
    return tree_map(lambda *each: np.concatenate(each), *answers)


def _player(registered: gymnasium.envs.registration.EnvSpec | None, *given: Any) -> LevelPlayer:
    """Returns a player, also in a process in which the environment is not registered yet."""
    if registered is not None:
        gymnasium.registry.setdefault(registered.id, registered)
    return LevelPlayer(*given)


@contextmanager
def _without_script() -> Iterator[None]:
    """Keeps new processes from running the script again, which may have no ``__main__`` guard."""
    with _STARTING:
        script = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = script


def _serve(pipe: Connection) -> None:
    """Steps environments until the pipe is closed or the parent has ended."""
    # These ask the parent to stop, which saves its work first; this process ends with the parent.
    for name in ("SIGINT", "SIGHUP", "SIGUSR1", "SIGUSR2"):
        if hasattr(signal, name):  # Windows has the first alone
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    torch.set_num_threads(1)  # there are as many processes as cores
    env: Any = None
    seen = None
    with suppress(EOFError, OSError):  # of the pipe; those of environments are answers
        while True:
            what, given = pipe.recv()
            try:
                if what == "make":
                    env = pickle.loads(given[0])()
                    answer: Any = env.single_observation_space, env.single_action_space
                elif what == "reset":
                    # A vector environment takes no mask in which nothing is true.
                    if given[0] is None or given[0]["reset_mask"].any():
                        seen = env.reset(options=given[0])[0]
                    answer = seen
                elif what == "step":
                    *answer, info = env.step(*given)
                    answer.append({"success": info.get("success", np.zeros_like(answer[-1]))})
                else:
                    answer = getattr(env, what)(*given)
                failed = False
            except Exception as error:
                failed, answer = True, error
            pipe.send((failed, answer))

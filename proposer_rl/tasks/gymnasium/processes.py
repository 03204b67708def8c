"""Environments of Gymnasium side by side in a few processes, each of which steps several."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import CloudpickleWrapper

from proposer_rl.models import callers_state

# A forked process need not import torch again, of which it has no use.
CONTEXT: Any = multiprocessing.get_context(
    "fork" if "fork" in multiprocessing.get_all_start_methods() else "spawn"
)


class LostProcessError(RuntimeError):
    """A process of the environments has ended; the message is one line."""

    exit_code = 6


class ProcessVectorEnv:
    """The part of Gymnasium's vector environments that is used here, over several processes.

    Which process an environment is in changes nothing that it does.

    Args:
        makes: make the environments.
        count: processes, at most as many as environments.

    Attributes:
        num_envs: number n of environments.
        single_observation_space, single_action_space: of each.
        processes: that step them.
    """

    def __init__(self, makes: Sequence[Callable[[], Any]], count: int) -> None:
        self.num_envs = len(makes)
        self._parts = np.array_split(np.arange(len(makes)), min(count, len(makes)))
        self._pipes: list[Connection] = []
        self.processes = []
        for part in self._parts:
            ours, theirs = CONTEXT.Pipe()
            some = [makes[index] for index in part]
            side_by_side = partial(SyncVectorEnv, some, autoreset_mode=AutoresetMode.DISABLED)
            make: Any = CloudpickleWrapper(side_by_side)
            process = CONTEXT.Process(target=_serve, args=(theirs, ours, make), daemon=True)
            process.start()
            theirs.close()
            self._pipes.append(ours)
            self.processes.append(process)
        found = self._ask("spaces", [()] * len(self._pipes))
        self.single_observation_space: spaces.Space[Any] = found[0][0]
        self.single_action_space: spaces.Space[Any] = found[0][1]

    def reset(self, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode everywhere, or where the options' ``reset_mask``, bool [n], says so."""
        parts = [(options and {"reset_mask": options["reset_mask"][part]},) for part in self._parts]
        return _joined(self._ask("reset", parts)), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One step of each, with actions [n, ...]."""
        answers = self._ask("step", [(actions[part],) for part in self._parts])
        seen, *ends, infos = zip(*answers, strict=True)
        success = [
            info.get("success", np.zeros(len(part), np.bool_))
            for info, part in zip(infos, self._parts, strict=True)
        ]
        rewards, terminated, truncated, successes = map(np.concatenate, (*ends, success))
        return _joined(seen), rewards, terminated, truncated, {"success": successes}

    def set_attr(self, name: str, values: Sequence[Any]) -> None:
        """Give each environment an attribute's value."""
        self._ask("set_attr", [(name, [values[i] for i in part]) for part in self._parts])

    def close(self) -> None:
        """End the processes."""
        for pipe, process in zip(self._pipes, self.processes, strict=True):
            # Processes that were forked later have the pipe, too: closing it would tell nothing.
            with suppress(OSError):
                pipe.send(None)
            process.join()

    def _ask(self, what: str, arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """The answers of all processes, which work at the same time.

        Raises:
            Exception: what the first environment that failed has raised.
            LostProcessError: if a process answers no more.
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
                "-9: killed, mostly for want of memory)"
            ) from error
        for failed, answer in answers:
            if failed:
                raise answer
        return [answer for _, answer in answers]


@callers_state()
def _serve(pipe: Connection, parents: Connection, make: Callable[[], Any]) -> None:
    """Step environments until the pipe is closed, or the parent is gone."""
    parents.close()
    # As its parent, which saves its work first, a forked process would otherwise answer signals.
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    env, seen = None, None
    while True:
        try:
            asked = pipe.recv()
        except EOFError:
            return
        if asked is None:
            return
        what, given = asked
        try:
            env = env or make()
            if what == "spaces":
                answer: Any = env.single_observation_space, env.single_action_space
            elif what == "reset":
                # A vector environment takes no mask in which nothing is true.
                if given[0] is None or given[0]["reset_mask"].any():
                    seen = env.reset(options=given[0])[0]
                answer = seen
            else:
                answer = getattr(env, what)(*given)
            pipe.send((False, answer))
        except Exception as error:
            pipe.send((True, error))


def _joined(parts: Sequence[Any]) -> Any:
    if isinstance(parts[0], dict):
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return np.concatenate(parts)

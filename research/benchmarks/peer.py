"""What others have made, in processes of interpreters that have it: jaxued's maze, Syllabus."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from proposer_rl.tasks.view_mazes.view_levels import ViewLevel
from research.benchmarks.jaxued_peer import __file__ as PROGRAM
from research.benchmarks.timing import Timings, interleave

ISOLATED = "-I"  # else it would find our packages, and our modules beside the program


class Peer(NamedTuple):
    """A process that plays jaxued's maze.

    Attributes:
        about: its versions and cores, for a reader.
        play: given one of :data:`research.benchmarks.jaxued_peer.WAYS`, plays all actions, given
            ``TRAINING`` makes an update; the seconds by the process's own clock, and the sum of
            rewards.
    """

    about: str
    play: Callable[[str], tuple[float, float]]

    def in_turn(
        self, ways: Sequence[str], ours: Mapping[str, Callable[[], object]], repeats: int
    ) -> Timings:
        """Time what is ours and some ways of the process in turn.

        Seconds of the ways are by the process's own clock, which leaves out the way there and back.
        """
        clock: Timings = {way: [] for way in ways}

        def theirs(way: str) -> None:
            clock[way].append(self.play(way)[0])

        calls = dict(ours) | {way: partial(theirs, way) for way in ways}
        seconds = interleave(calls, repeats)
        return seconds | {way: times[-repeats:] for way, times in clock.items()}


def said_by(python: str, program: str, *arguments: object) -> dict[str, Any]:
    """What a program says in an interpreter; without arguments it only tries to import its peer.

    Raises:
        ValueError: If it cannot, or if there is no such interpreter; the message is one line.
    """
    command = [python, ISOLATED, program, *map(str, arguments)]
    try:
        ended = subprocess.run(command, capture_output=True, text=True)
    except OSError as error:
        raise ValueError(str(error.strerror)) from error
    if ended.returncode or not ended.stdout.startswith("{"):
        raise ValueError((ended.stderr.strip() or "it does not run Python").splitlines()[-1])
    found: dict[str, Any] = json.loads(ended.stdout)
    return found


@contextmanager
def jaxued_maze(
    python: str,
    levels: ViewLevel,
    actions: Tensor,
    max_steps: int,
    numbers: Mapping[str, float] | None = None,
) -> Iterator[Peer]:
    """A process that has jaxued's maze in memory, with as many cores as torch has threads.

    Args:
        python: an interpreter that has jaxued.
        levels: N of one size.
        actions: int64 [T, N], of ours, which are jaxued's first three.
        max_steps: of an episode.
        numbers: of PPO and the network, for training.

    Yields:
        The process; it is killed in the end.

    Raises:
        RuntimeError: If it ends before; its own last words are on stderr.
    """
    with TemporaryDirectory() as folder:
        file = Path(folder) / "played.npz"
        arrays = played(levels, actions, max_steps)
        np.savez(file, **arrays, numbers=np.asarray(json.dumps(numbers)))
        command = [python, ISOLATED, PROGRAM, str(file), str(torch.get_num_threads())]
        # Unbuffered, so that nothing is left to be written when it has ended.
        with subprocess.Popen(
            command, bufsize=0, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as process:
            try:
                found = _answer(process)
                about = "jaxued {jaxued}, jax {jax}, on {cores} core(s)".format(**found)

                def play(way: str) -> tuple[float, float]:
                    said = _answer(process, way)
                    return said["seconds"], said["reward"]

                yield Peer(about, play)
            finally:
                process.kill()


def played(levels: ViewLevel, actions: Tensor, max_steps: int) -> dict[str, Any]:
    """Levels [N] and actions [T, N] as jaxued has them, whose cells are column and row.

    Returns:
        ``wall_map`` bool [N, H, W], ``goal_pos`` and ``agent_pos`` uint32 [N, 2], ``agent_dir``
        uint8 [N], ``actions`` int32 [T, N], ``max_steps`` [].
    """
    return {
        "wall_map": levels.walls.cpu().numpy(),
        "goal_pos": levels.goal.flip(-1).cpu().numpy().astype(np.uint32),
        "agent_pos": levels.start.flip(-1).cpu().numpy().astype(np.uint32),
        "agent_dir": levels.direction.cpu().numpy().astype(np.uint8),
        "actions": actions.cpu().numpy().astype(np.int32),
        "max_steps": np.asarray(max_steps),
    }


def _answer(process: subprocess.Popen[bytes], order: str = "") -> dict[str, Any]:
    """What it says next, after an order if there is one."""
    assert process.stdin is not None and process.stdout is not None
    if order:
        with suppress(BrokenPipeError):  # it has ended; so has what it says
            process.stdin.write(f"{order}\n".encode())
    line = process.stdout.readline()
    if not line:
        raise RuntimeError(f"jaxued's process ended with exit code {process.wait()}")
    answer: dict[str, Any] = json.loads(line)
    return answer

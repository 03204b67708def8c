"""Syllabus' own calls in an interpreter that has it: what an episode costs its curricula.

``PYTHON -I syllabus_peer.py`` says in one line of JSON which Syllabus there is; with TASKS, COUNT
and REPEATS also the ``seconds`` of an episode in each repetition, by the calls that it makes. It
imports nothing of ours.

Syllabus 0.7 as shipped asks for matplotlib and SciPy without saying so. Of prioritized level replay
the calls are those of its sampler, below the storage of rollouts: a draw from tasks all of which
have a score, and a new score; its ``sample`` fails then without an evaluator. TeachMyAgent, the
other one with such calls, is in no package index and needs Python 3.6 or 3.7: it is not timed.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any


def main() -> None:
    """Entry point; the module says what is read and written."""
    calls = episodes(int(sys.argv[1]) if len(sys.argv) > 1 else 2)
    found: dict[str, Any] = {"syllabus": version("syllabus-rl")}
    if len(sys.argv) > 1:
        count, repeats = map(int, sys.argv[2:])
        found["seconds"] = {name: [] for name in calls}
        for _ in range(repeats):
            for name, episode in calls.items():
                start = time.perf_counter()
                for number in range(count):
                    episode(number)
                found["seconds"][name].append((time.perf_counter() - start) / count)
    print(json.dumps(found), flush=True)


def episodes(tasks: int) -> dict[str, Callable[[int], None]]:
    """What is called for an episode, by the curriculum."""
    from syllabus.curricula import DomainRandomization
    from syllabus.curricula.plr.task_sampler import TaskSampler
    from syllabus.task_space import DiscreteTaskSpace

    uniform = DomainRandomization(DiscreteTaskSpace(tasks))
    replay = TaskSampler([*range(tasks)], 256)
    for task in range(tasks):
        replay.update_task_score(0, task, task % 7, task % 7, 1)

    def uniformly(number: int) -> None:
        (task,) = uniform.sample(1)
        uniform.update_on_episode(number % 7, 1, task, number % 2, 0)

    def replayed(number: int) -> None:
        task = replay._sample_replay_level()
        replay.update_task_score(0, task, number % 7, number % 7, 1)

    return {"domain randomization": uniformly, "PLR's sampler": replayed}


if __name__ == "__main__":
    main()

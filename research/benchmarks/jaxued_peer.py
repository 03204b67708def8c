"""jaxued's maze in an interpreter that has jaxued: a program that plays when it is told to.

``PYTHON -I jaxued_peer.py`` says in one line of JSON which jaxued and jax there are. With FILE and
CORES it says so after having confined itself to as many cores, then plays the arrays of FILE
(:func:`research.benchmarks.peer.played`) once for every line that it reads, which names one of
``WAYS``, and
answers each with the seconds and the sum of all rewards. It ends with its input. It imports nothing
of ours, since that interpreter need not have torch.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.metadata import version
from typing import Any

WRAPPER, LEAN = "wrapper", "lean"
WAYS = (WRAPPER, LEAN)
"""How an episode that ended begins anew: ``wrapper`` is jaxued's own AutoReplayWrapper, which makes
the level's map again at every step; ``lean`` sets only what an episode changes, as jaxued's users
could."""


def main() -> None:
    """Entry point; the module says what is read and written."""
    arguments = sys.argv[1:]
    held = confined(int(arguments[1])) if arguments else None
    os.environ["JAX_PLATFORMS"] = "cpu"  # where there is a GPU, JAX would take it
    import_module("jaxued.environments.maze")
    found = {"jaxued": version("jaxued"), "jax": version("jax"), "cores": held}
    print(json.dumps(found), flush=True)
    if arguments:
        _serve(arguments[0])


def confined(cores: int) -> int | None:
    """Keep to so many of the cores that this process may use, where the system can be told so.

    Returns:
        How many there are then; None where nobody knows.
    """
    if not hasattr(os, "sched_setaffinity"):  # macOS
        return os.cpu_count()
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
    return len(os.sched_getaffinity(0))


def _serve(file: str) -> None:
    import numpy as np

    with np.load(file) as arrays:
        plays = {way: player(arrays, way) for way in WAYS}
    for line in sys.stdin:
        start = time.perf_counter()
        rewards = plays[line.strip()]()
        seconds = time.perf_counter() - start
        total = float(np.asarray(rewards, dtype=np.float64).sum())
        print(json.dumps({"seconds": seconds, "reward": total}), flush=True)


def player(arrays: Mapping[str, Any], way: str) -> Callable[[], Any]:
    """A compiled rollout, as the field trains: ``lax.scan`` over the steps of a batch in one jit.

    Args:
        arrays: as :func:`research.benchmarks.peer.played` makes them, of N levels and T steps.
        way: one of ``WAYS``.

    Returns:
        What plays them all, waits, and returns the rewards, float32 [T, N]. Its first call
        compiles.
    """
    import jax
    import jax.numpy as jnp
    from jaxued.environments.maze import Level, Maze
    from jaxued.wrappers import AutoReplayWrapper

    if not hasattr(jax, "tree_map"):
        jax.tree_map = jax.tree.map  # of JAX's newer versions, and what jaxued's wrapper calls
    height, width = arrays["wall_map"].shape[1:]
    maze = Maze(max_height=height, max_width=width, agent_view_size=5)
    env = AutoReplayWrapper(maze) if way == WRAPPER else maze
    limits = env.default_params.replace(max_steps_in_episode=int(arrays["max_steps"]))
    levels = Level(
        **{name: jnp.asarray(arrays[name]) for name in ("wall_map", "goal_pos", "agent_pos")},
        agent_dir=jnp.asarray(arrays["agent_dir"]),
        width=jnp.full(len(arrays["agent_dir"]), width),
        height=jnp.full(len(arrays["agent_dir"]), height),
    )
    actions = jnp.asarray(arrays["actions"])
    key = jax.random.PRNGKey(0)  # asked for by the interface; nothing in this maze is random

    def step(begun: Any, state: Any, action: Any) -> Any:
        seen, state, reward, done, _ = env.step(key, state, action, limits)
        if way == LEAN:
            first_seen, first = begun
            changed = {
                name: jnp.where(done, getattr(first, name), getattr(state, name))
                for name in ("agent_pos", "agent_dir", "time", "terminal")
            }
            state = state.replace(**changed)
            seen = jax.tree.map(lambda new, old: jnp.where(done, new, old), first_seen, seen)
        return state, (seen, reward, done)

    @jax.jit
    def rollout(levels: Any, actions: Any) -> Any:
        begun = jax.vmap(lambda level: env.reset_to_level(key, level, limits))(levels)
        # Observations are kept, as by those who train on them: else none would be computed.
        return jax.lax.scan(
            lambda state, action: jax.vmap(step)(begun, state, action), begun[1], actions
        )[1]

    return lambda: jax.block_until_ready(rollout(levels, actions))[1]


if __name__ == "__main__":
    main()

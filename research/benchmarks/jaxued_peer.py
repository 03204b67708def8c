"""jaxued's maze in an interpreter that has jaxued: a program that plays or trains when told to.

``PYTHON -I jaxued_peer.py`` says in one line of JSON which jaxued and jax there are. With FILE and
CORES it says so after having confined itself to as many cores, then plays the arrays of FILE
(:func:`research.benchmarks.peer.played`) once for every line that it reads, which names one of
``WAYS``, and
answers each with the seconds and the sum of all rewards; ``TRAINING`` makes one update of a policy
instead. It ends with its input. It imports nothing of ours, since that interpreter need not have
torch.
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
TRAINING = "training"


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

    with np.load(file) as loaded:
        arrays = dict(loaded)
    made: dict[str, Callable[[], Any]] = {}
    for line in sys.stdin:
        way = line.strip()
        if way not in made:
            made[way] = trainer(arrays) if way == TRAINING else player(arrays, way)
        start = time.perf_counter()
        rewards = made[way]()
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

    env, limits, levels = _environment(arrays, wrapped=way == WRAPPER)
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


def trainer(arrays: Mapping[str, Any]) -> Callable[[], Any]:
    """PPO with an LSTM on N levels, as the script of jaxued that draws them at random has it.

    Its network has all seven actions and MiniGrid's three numbers of a cell.

    Args:
        arrays: as :func:`research.benchmarks.peer.played` makes them, with the numbers of PPO.

    Returns:
        What resets to the levels, acts for T steps, makes the gradient steps of one update, waits,
        and returns the rewards, float32 [T, N]. Its first call compiles.
    """
    import distrax
    import flax.linen as nn
    import jax
    import jax.numpy as jnp
    import optax
    from jaxued.linen import ResetRNN

    env, limits, levels = _environment(arrays, wrapped=True, normalize_obs=True)
    numbers = json.loads(str(arrays["numbers"]))
    steps, count, key = len(arrays["actions"]), len(arrays["agent_dir"]), jax.random.PRNGKey(0)
    root = nn.initializers.orthogonal

    class Network(nn.Module):
        @nn.compact
        def __call__(self, seen: Any, begins: Any, memory: Any) -> Any:
            image = nn.Conv(numbers["channels"], (3, 3), padding="VALID")(seen.image)
            image = nn.relu(image.reshape(*begins.shape, -1))
            looks = jax.nn.one_hot(seen.agent_dir, 4)
            looks = nn.Dense(numbers["direction"], kernel_init=root(2**0.5))(looks)
            lstm = nn.OptimizedLSTMCell(numbers["memory"])
            given = jnp.concatenate([image, looks], -1), begins
            memory, known = ResetRNN(lstm)(given, initial_carry=memory)

            def head(outputs: int, gain: float) -> Any:
                hidden = nn.Dense(numbers["head"], kernel_init=root(2.0))(known)
                return nn.Dense(outputs, kernel_init=root(gain))(nn.relu(hidden))

            policy = distrax.Categorical(logits=head(env.action_space(limits).n, 0.01))
            return memory, policy, head(1, 1.0).squeeze(-1)

    network, forgotten = Network(), nn.OptimizedLSTMCell(numbers["memory"])
    forgotten = forgotten.initialize_carry(key, (count, numbers["memory"]))
    adam = optax.adam(numbers["learning_rate"], eps=numbers["adam_eps"])
    optimiser = optax.chain(optax.clip_by_global_norm(numbers["max_grad_norm"]), adam)

    def once(tree: Any) -> Any:
        return jax.tree.map(lambda leaf: leaf[None], tree)

    def reset() -> Any:
        return jax.vmap(lambda level: env.reset_to_level(key, level, limits))(levels)

    def act(weights: Any, standing: Any, key: Any) -> Any:
        memory, seen, state, begins = standing
        memory, policy, value = network.apply(weights, once(seen), begins[None], memory)
        action, log_prob = (drawn[0] for drawn in policy.sample_and_log_prob(seed=key))
        move = jax.vmap(env.step, (None, 0, 0, None))
        after, state, reward, done, _ = move(key, state, action, limits)
        step = (seen, begins, action, log_prob, value[0], reward, done)
        return (memory, after, state, done), step

    def estimate(following: Any, step: Any) -> Any:
        advantage, next_value = following
        *_, value, reward, done = step
        goes_on = numbers["gamma"] * (1 - done)
        error = reward + goes_on * next_value - value
        advantage = error + goes_on * numbers["lmbda"] * advantage
        return (advantage, value), advantage

    def loss(weights: Any, taken: Any, advantage: Any) -> Any:
        seen, begins, action, acted, value, *_ = taken
        _, policy, now = network.apply(weights, seen, begins, forgotten)
        target, clip = advantage + value, numbers["clip_epsilon"]
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-5)
        ratio = jnp.exp(policy.log_prob(action) - acted)
        gain = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - clip, 1 + clip) * advantage)
        near = value + jnp.clip(now - value, -clip, clip)
        error = jnp.maximum((now - target) ** 2, (near - target) ** 2).mean()
        entropy = policy.entropy().mean()
        return -gain.mean() + numbers["critic_coeff"] * error - numbers["entropy_coeff"] * entropy

    @jax.jit
    def update(weights: Any, moments: Any, key: Any) -> Any:
        begun = (forgotten, *reset(), jnp.zeros(count, bool))
        draws = jax.random.split(key, steps)
        standing, taken = jax.lax.scan(lambda *at: act(weights, *at), begun, draws)
        memory, seen, _, begins = standing
        last = network.apply(weights, once(seen), begins[None], memory)[2][0]
        none = (jnp.zeros(count), last)
        _, advantage = jax.lax.scan(estimate, none, taken, reverse=True, unroll=16)

        def epoch(trained: Any, _: Any) -> Any:
            weights, moments = trained
            gradient = jax.grad(loss)(weights, taken, advantage)
            change, moments = optimiser.update(gradient, moments, weights)
            return (optax.apply_updates(weights, change), moments), None

        trained, _ = jax.lax.scan(epoch, (weights, moments), None, numbers["epochs"])
        return *trained, taken[5]

    weights = network.init(key, once(reset()[0]), jnp.zeros((1, count), bool), forgotten)
    trained = [weights, optimiser.init(weights), key]

    def train() -> Any:
        weights, moments, key = trained
        key, now = jax.random.split(key)
        *after, rewards = jax.block_until_ready(update(weights, moments, now))
        trained[:] = *after, key
        return rewards

    return train


def _environment(
    arrays: Mapping[str, Any], *, wrapped: bool, normalize_obs: bool = False
) -> tuple[Any, Any, Any]:
    """Jaxued's maze, its numbers, and levels [N] in it."""
    import jax
    import jax.numpy as jnp
    from jaxued.environments.maze import Level, Maze
    from jaxued.wrappers import AutoReplayWrapper

    if not hasattr(jax, "tree_map"):
        jax.tree_map = jax.tree.map  # of JAX's newer versions, and what jaxued's wrapper calls
    height, width = arrays["wall_map"].shape[1:]
    maze = Maze(max_height=height, max_width=width, agent_view_size=5, normalize_obs=normalize_obs)
    env = AutoReplayWrapper(maze) if wrapped else maze
    limits = env.default_params.replace(max_steps_in_episode=int(arrays["max_steps"]))
    levels = Level(
        **{name: jnp.asarray(arrays[name]) for name in ("wall_map", "goal_pos", "agent_pos")},
        agent_dir=jnp.asarray(arrays["agent_dir"]),
        width=jnp.full(len(arrays["agent_dir"]), width),
        height=jnp.full(len(arrays["agent_dir"]), height),
    )
    return env, limits, levels


if __name__ == "__main__":
    main()

"""Policies act in other code as the Solver does in its training and evaluations."""

from __future__ import annotations

import json
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from tensordict import TensorDict
from torch.utils._pytree import tree_leaves, tree_map
from torchrl.envs import (
    Compose,
    GymEnv,
    InitTracker,
    TransformedEnv,
)
from torchrl.envs.utils import ExplorationType, set_exploration_type

from proposer_rl.api import Run
from proposer_rl.cli.errors import ConfigError
from proposer_rl.learning import PPO, PPOSettings, SolverSettings
from proposer_rl.streams import Streams
from proposer_rl.tasks.gymnasium.batched_env import plays
from proposer_rl.tasks.gymnasium.networks import NetworkSettings
from proposer_rl.tasks.gymnasium.spaces import Layout, cast_to, in_order
from proposer_rl.tasks.policy import Policy, policy_of
from tests.processes import ROOT, python
from tests.tasks.gymnasium.odd import LIMIT, Line, odd
from tests.tasks.gymnasium.toys import CHOICES, TINY, walk_task
from tests.tiny import mountain_cars, point_masses, tiny_task, tiny_view_task

ODD = "tests.tasks.gymnasium.odd:"
WALK = "tests.tasks.gymnasium.toys:Walk-v0"
NORMALIZED = ["solver.ppo.normalize_observations=true", "solver.ppo.normalize_rewards=true"]


def stacked(first: bool) -> str:
    """A line that shows two images in a stack, with channels before or behind, and choices."""
    shape = (2, 3, 20, 24) if first else (2, 20, 24, 3)

    def seen(self: Any) -> Any:
        image = np.random.default_rng(self.t).integers(0, 255, shape).astype(np.uint8)
        return image, np.array([[-1, 7], [self.t % 3, 5]])

    def step(self: Any, action: Any) -> Any:
        assert self.action_space.contains(action)
        return Line.step(self, action[0] - 3)

    choices = spaces.MultiDiscrete([[3, 2], [4, 1]], start=[[-2, 6], [0, 5]])
    return odd(
        observation_space=spaces.Tuple((spaces.Box(0, 255, shape, np.uint8), choices)),
        action_space=spaces.MultiDiscrete([2, 3], start=[3, -1]),
        seen=seen,
        step=step,
    )


KINDS = {
    "mixed": f"{ODD}Mixed-v0",
    "grey": f"{ODD}Grey-v0",
    "robot": f"{ODD}Robot-v0",
    "walk": WALK,
    "stack": stacked(True),
    "channels_last": stacked(False),
}


@cache
def solver(env_id: str, memory: int | None = None) -> tuple[PPO, Policy]:
    """A Solver with large weights and moments of some updates, so that its actions differ."""
    ppo = PPOSettings(
        horizon=8,
        epochs=1,
        normalize_observations=env_id != KINDS["grey"],  # bytes are not
        normalize_rewards=True,
        learning_rate=0.02,
    )
    network = NetworkSettings(hidden=[8], memory=memory)
    solver = SolverSettings(batch_size=4, ppo=ppo)
    task = walk_task(env_id=env_id, parameters={}, network=network, solver=solver)
    learner = task.learner([Streams(0)])
    learner.update([torch.Generator().manual_seed(0)])
    with torch.no_grad():
        for parameter in learner.agent.parameters():
            parameter *= 3
    return learner, policy_of(task, learner)


def same(one: Any, other: Any) -> bool:
    """Whether two observations or actions are equal, in structure, numbers and their types."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    one, other = np.asarray(one), np.asarray(other)
    return one.dtype == other.dtype and bool((one == other).all()) and one.shape == other.shape


@pytest.mark.parametrize("memory", [None, 8])
@pytest.mark.parametrize("kind", KINDS)
def test_it_acts_as_the_solver_in_its_environment(kind: str, memory: int | None) -> None:
    """In Gymnasium's loop the same actions as the agent's on what the task shows it."""
    learner, policy = solver(KINDS[kind], memory)
    agent, env = learner.agent, gymnasium.make(KINDS[kind])
    layout = Layout(env.observation_space, env.action_space)
    state, taken = None, []
    for seed in range(4):  # of which every other draws its actions
        observation, _ = env.reset(seed=seed)
        kept, begins, over = agent.no_memory(TensorDict({}, [1, 1])), True, False
        while not over:
            plain = in_order(env.observation_space, cast_to(env.observation_space, observation))
            entries = layout.entries(torch.as_tensor(part)[None, None] for part in plain)
            seen = TensorDict({**entries, **kept, "is_init": [[[begins]]]}, [1, 1])
            with torch.no_grad():
                after = agent(seen)
            kept = {name: after["next", name] for name in agent.memory}
            torch.manual_seed(len(taken))
            distribution = agent.distribution(after)
            chosen = (distribution.sample() if seed % 2 else distribution.mode)[0, 0]
            torch.manual_seed(len(taken))
            action, state = policy.predict(observation, state, begins, seed % 2 == 0)
            assert env.action_space.contains(action) and same(action, layout.taken(chosen))
            assert (state is None) == (memory is None)
            observation, _, terminated, truncated, _ = env.step(action)
            over, begins = terminated or truncated, False
            taken.append(tree_leaves(action))
    assert len({str(action) for action in taken}) > 1


@pytest.mark.parametrize("kind", KINDS)
def test_a_batch_is_that_of_a_vector_environment(kind: str) -> None:
    _, policy = solver(KINDS[kind], 8)
    env = gymnasium.make_vec(KINDS[kind], 3)
    observation, _ = env.reset(seed=3)
    state, begins = None, np.ones(3, np.bool_)
    singly: list[Any] = [None] * 3
    for _ in range(15):  # longer than an episode
        each = list(gymnasium.vector.utils.iterate(env.observation_space, observation))
        alone = [policy.predict(*one) for one in zip(each, singly, begins, strict=True)]
        actions, state = policy.predict(observation, state, begins)
        assert state is not None
        rows = gymnasium.vector.utils.iterate(env.action_space, actions)
        for row, memory, (action, singly_after) in zip(
            rows, zip(*state, strict=True), alone, strict=True
        ):
            np.testing.assert_allclose(tree_leaves(memory), tree_leaves(singly_after), atol=1e-5)
            pairs = zip(tree_leaves(row), tree_leaves(action), strict=True)
            assert all(np.allclose(a, b, atol=1e-5) for a, b in pairs)
        singly = [after for _, after in alone]
        observation, _, terminated, truncated, _ = env.step(actions)
        begins = terminated | truncated


def test_drawn_actions_have_the_policys_probabilities(tmp_path: Path) -> None:
    learner, policy = solver(WALK)
    seen = np.tile([0.3, 1.0], (20_000, 1))
    torch.manual_seed(5)
    drawn, _ = policy.predict(seen, deterministic=False)
    with torch.no_grad():
        state = learner.agent(
            TensorDict({"observation": torch.tensor(seen[:1]).float()[None]}, [1, 1])
        )
    expected = state["logits"].softmax(-1)[0, 0, 1].item()
    assert 0.02 < expected < 0.98 and {*drawn} == {1, 2}
    assert abs((drawn == 2).mean() - expected) < 4 * (0.25 / len(drawn)) ** 0.5

    torch.manual_seed(0)
    policy.save(tmp_path / "policy.pt2", deterministic=False)
    drawn = torch.export.load(tmp_path / "policy.pt2").module()(torch.as_tensor(seen)).numpy()
    assert abs((drawn == 2).mean() - expected) < 4 * (0.25 / len(drawn)) ** 0.5


@pytest.mark.parametrize("memory", [None, 8])
def test_it_is_an_actor_of_torchrl(memory: int | None) -> None:
    """A rollout has the actions of Gymnasium's loop; a Discrete observation must not be one-hot."""
    _, policy = solver(f"{ODD}Truck-v0", memory)
    assert {*policy.in_keys[:2]} == {("deep", "count"), "place"} and policy.out_keys[0] == "action"
    env: Any = GymEnv("Truck-v0", categorical_action_encoding=True)
    if memory:
        env = TransformedEnv(env, Compose(InitTracker(), policy.primer()))
    env.set_seed(5)
    rollout = env.rollout(LIMIT, policy)
    state = None
    for step in rollout:
        shown = {"place": step["place"].numpy(), "deep": {"count": int(step["deep", "count"])}}
        action, state = policy.predict(shown, state)
        assert action.tolist() == step["action"].tolist()
    with set_exploration_type(ExplorationType.RANDOM):
        drawn = [env.rollout(LIMIT, policy)["action"] for _ in range(2)]
    assert drawn[0].shape != drawn[1].shape or not torch.equal(*drawn)
    with pytest.raises(ValueError, match=r"deep.count: must have the shape \[\]"):
        policy(GymEnv("Truck-v0").reset())


@pytest.mark.parametrize("make", [tiny_task, tiny_view_task, point_masses, mountain_cars])
def test_in_the_tasks_own_environments_it_acts_as_the_solver(make: Any) -> None:
    task = make()
    learner = task.learner([Streams(1)])
    policy, levels = policy_of(task, learner), task.target.sample(5, Streams(2).generator())
    envs = [task.environment(batch) for batch in (levels, levels[None])]
    if learner.agent.memory:
        envs = [TransformedEnv(env, policy.primer()) for env in envs]
    rollout = envs[0].rollout(8, policy, break_when_any_done=False)
    expected = envs[1].rollout(8, learner.agent.actor(), break_when_any_done=False)
    torch.testing.assert_close(rollout["action"], expected["action"][0])
    names = getattr(policy.observation_space, "spaces", None)
    first = rollout[:, 0].numpy()
    seen = first["observation"] if names is None else {name: first[name] for name in names}
    actions, _ = policy.predict(seen)
    np.testing.assert_allclose(actions, rollout["action"][:, 0].numpy(), rtol=1e-4)


ALONE = """
import sys
for name in ("proposer_rl", "tensordict", "torchrl", "gymnasium"):
    sys.modules[name] = None  # what imports it fails
import torch
for file in sys.argv[1:]:
    policy = torch.export.load(file).module()
    for given, expected in torch.load(file + ".cases"):
        torch.testing.assert_close(policy(*given), expected, rtol=1e-4, atol=1e-5)
        print(file)
"""


def test_exported_policies_need_torch_alone(tmp_path: Path) -> None:
    """Batches of several sizes, and two steps in a row with a memory that some rows forget."""
    files = []
    kinds = {"mixed": 8, "robot": None, "channels_last": None}
    policies = {kind: solver(KINDS[kind], memory)[1] for kind, memory in kinds.items()}
    for make in (tiny_task, tiny_view_task):
        task = make()
        policies[make.__name__] = policy_of(task, task.learner([Streams(0)]))
    for name, policy in policies.items():
        file, cases = tmp_path / f"{name}.pt2", []
        policy.save(file)
        for count in (1, 3, 20):
            space = gymnasium.vector.utils.batch_space(policy.observation_space, count)
            space.seed(count)
            state: Any = None
            for begins in (np.ones(count, np.bool_), np.arange(count) % 2 == 0):
                seen = space.sample()
                before, (action, state) = state, policy.predict(seen, state, begins)
                given, expected = (seen,), action
                if state is not None:
                    before = before or tuple(np.zeros_like(part) for part in state)
                    given, expected = (seen, before, begins), (action, state)
                cases.append(tree_map(torch.as_tensor, (given, expected)))
        torch.save(cases, f"{file}.cases")
        files.append(str(file))
    command = [sys.executable, "-c", ALONE, *files]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout.split() == [file for file in files for _ in range(6)], done.stderr


LOOP = """
import json, sys
from pathlib import Path
import gymnasium
import proposer_rl as prl

for folder, env_id, seed, levels in json.loads(sys.argv[1]):
    policy, results = prl.Run(Path(folder)).policy(seed=seed), []
    for attributes, reset_seed in levels:
        env = gymnasium.make(env_id, max_episode_steps=12)
        for name, value in attributes.items():
            setattr(env.unwrapped, name, value)
        observation, _ = env.reset(seed=reset_seed)
        total, over, state = 0.0, False, None
        while not over:
            action, state = policy.predict(observation, state)
            observation, reward, terminated, truncated, _ = env.step(action)
            total, over = total + reward, terminated or truncated
        results.append(total)
    print(json.dumps(results))
"""


@pytest.mark.usefixtures("own_folder")
def test_a_plain_loop_in_a_new_process_reaches_what_was_measured(train: Any) -> None:
    """Of the second of two seeds with moments; and with nested dictionaries and a memory."""
    greedy = ["task.evaluation.actions=most_probable", "task.evaluation.levels=6", "+method=target"]
    truck = [word.replace("Mixed", "Truck") for word in CHOICES if "channels" not in word]
    runs = {
        "cartpole": ["task=cartpole", *TINY, *NORMALIZED, "seeds=[0,1]", "solver.ppo.epochs=20"],
        "truck": [*truck, "task.network.memory=8"],
    }
    asked, expected = [], []
    for name, words in runs.items():
        assert train(*words, *greedy, f"hydra.run.dir={name}") == 0
        run = Run(Path(name))
        task, agent, levels = run.task(), run.solver(), run.task().evaluated_on["all"]
        expected.append(task.performance(agent, levels, torch.Generator())["return"][-1].tolist())
        given = []
        for play in plays(levels, task._parameters):
            values = {**play.values, "force_mag": play.values.get("force")}
            if name == "cartpole":
                length = values["half length"]
                values |= {"length": length, "polemass_length": 0.1 * length}
            given.append(({n: v for n, v in values.items() if v is not None}, play.seed))
        env_id = "CartPole-v1" if name == "cartpole" else f"{ODD}Truck-v0"
        asked.append((name, env_id, agent.copies - 1, given))
    done = python(LOOP, json.dumps(asked), path=ROOT, folder=Path())
    found = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(found) == 2, done.stderr
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert all(len({*returns}) > 2 for returns in expected)
    with pytest.raises(ConfigError, match=r"seed=7: must be among \[0, 1\]"):
        Run(Path("cartpole")).policy(seed=7)

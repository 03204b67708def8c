from __future__ import annotations

import copy
import pickle

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.envs.utils import RandomPolicy, check_env_specs

from proposer_rl.tasks.mazes import Level, MazeEnv, planes, successors
from tests.tasks.mazes.oracles import moved, play, random_levels

UP, DOWN, LEFT, RIGHT = range(4)
ROOM = Level.from_text("S.#\n..G")


def step(env: MazeEnv, state: TensorDictBase, action: int) -> TensorDictBase:
    return env.step(state.set("action", torch.full(env.batch_size, action)))["next"]


@pytest.mark.parametrize("shape", [(), (1,), (3,), (2, 3)])
@pytest.mark.parametrize("observe_agent", [False, True])
def test_specs(shape: tuple[int, ...], observe_agent: bool) -> None:
    levels = random_levels(6, 4, 5, 0.2, 0)[: torch.Size(shape).numel()].reshape(shape)
    env = MazeEnv(levels, max_steps=3, observe_agent=observe_agent)
    check_env_specs(env, break_when_any_done="both")
    assert env.reset()["planes"].shape == (*shape, 4 if observe_agent else 3, 4, 5)


def test_successors_agree_with_moves_one_by_one() -> None:
    levels = random_levels(20, 4, 3, 0.3, 0).reshape(4, 5)
    table = successors(levels)
    assert (table.shape, table.dtype) == ((4, 5, 4, 12), torch.int64)
    for level, actions in zip(levels.reshape(-1), table.flatten(0, 1).tolist(), strict=True):
        for action, cells in enumerate(actions):
            for cell in (~level.walls).flatten().nonzero().flatten().tolist():
                row, column = moved(level, divmod(cell, 3), action)
                assert cells[cell] == row * 3 + column


def test_agent_is_observed_on_demand_only() -> None:
    seeing, blind = MazeEnv(ROOM, observe_agent=True), MazeEnv(ROOM)
    shown, state = seeing.reset(), blind.reset()
    for action in (DOWN, RIGHT, UP):
        assert torch.equal(state["planes"], planes(ROOM))
        assert torch.equal(shown["planes"][:3], planes(ROOM))
        assert shown["planes"][3].nonzero().tolist() == [shown["agent"].tolist()]
        shown, state = step(seeing, shown, action), step(blind, state, action)
    assert shown["planes"][3].nonzero().tolist() == [[0, 1]]


@settings(max_examples=40)
@given(
    size=st.tuples(st.integers(1, 5), st.integers(2, 5)),
    seed=st.integers(0, 10_000),
    max_steps=st.integers(1, 8),
    fraction=st.sampled_from([0.0, 0.3]),
)
def test_rollouts_agree_with_a_simulator(
    size: tuple[int, int], seed: int, max_steps: int, fraction: float
) -> None:
    """Over several episodes, so that the resets in between are played too."""
    levels = random_levels(4, *size, fraction, seed)
    actions = torch.randint(4, (20, 4), generator=torch.Generator().manual_seed(seed))
    remaining = iter(actions)
    env = MazeEnv(levels.reshape(2, 2), max_steps=max_steps, step_penalty=0.25)
    steps = env.rollout(
        20,
        policy=lambda *observation: next(remaining).view(2, 2),
        break_when_any_done=False,
    )
    steps = steps.reshape(4, 20)
    for i, level in enumerate(levels):
        following = steps[i]["next"]
        seen = zip(
            map(tuple, following["agent"].tolist()),
            following["reward"].flatten().tolist(),
            following["terminated"].flatten().tolist(),
            following["truncated"].flatten().tolist(),
            strict=True,
        )
        assert list(seen) == list(play(level, actions[:, i].tolist(), max_steps, 0.25))
        after_end = steps[i]["agent"][1:][following["done"].flatten()[:-1]]
        assert (after_end == level.start).all()
        assert torch.equal(steps[i]["planes"], planes(level).expand(20, -1, -1, -1))


def test_unfinished_episodes_end_on_the_levels_they_began_on() -> None:
    old = Level.from_text(["S.G", "SG."])
    new = Level.from_text(["G.S", ".GS"])
    env = MazeEnv(old, max_steps=9)
    state = env.reset()
    env.set_levels(new)
    _, state = env.step_and_maybe_reset(state.set("action", torch.tensor([RIGHT, RIGHT])))
    assert state["agent"].tolist() == [[0, 1], [0, 2]]  # the second one ended and began anew
    assert env.levels.to_text() == ["S.G", ".GS"]
    assert torch.equal(state["planes"], planes(env.levels))
    _, state = env.step_and_maybe_reset(state.set("action", torch.tensor([RIGHT, RIGHT])))
    assert state["agent"].tolist() == [[0, 2], [0, 2]]
    assert env.levels.to_text() == ["G.S", ".GS"]


def test_what_is_stepped_decides_where_the_agent_is() -> None:
    """A step is a function of the tensordict, so any state can be returned to."""
    env = MazeEnv(ROOM)
    here = env.reset()
    there = step(env, here.clone(), DOWN)
    step(env, there.clone(), RIGHT)
    again = step(env, here.clone(), DOWN)
    assert (there == again).all()


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copies_play_on_their_own(duplicate: object) -> None:
    env = MazeEnv(random_levels(2, 4, 4, 0.2, 0))
    other = duplicate(env)
    other.set_levels(random_levels(2, 4, 4, 0.2, 1))
    other.reset()
    assert (env.levels == random_levels(2, 4, 4, 0.2, 0)).all()
    assert (other.levels == random_levels(2, 4, 4, 0.2, 1)).all()


def test_collector_plays_the_levels_that_are_set_between_its_batches() -> None:
    def levels(seed: int) -> Level:
        return random_levels(6, 5, 5, 0.2, seed).reshape(2, 3)

    env = MazeEnv(levels(0), max_steps=7)
    collector = Collector(
        env,
        RandomPolicy(env.action_spec),
        frames_per_batch=2 * 3 * 25,
        total_frames=-1,
        reset_at_each_iter=True,
    )
    batches = iter(collector)
    for seed in range(3):
        env.set_levels(levels(seed))
        steps = next(batches)
        assert steps.batch_size == (2, 3, 25)
        assert torch.equal(steps["agent"][..., 0, :], levels(seed).start)
        assert (steps["planes"] == planes(levels(seed)).unsqueeze(2)).all()
        assert steps["next", "done"].any()
        ended = steps["next", "done"][:, :, :-1, 0]
        starts = levels(seed).start.unsqueeze(2).expand(-1, -1, 24, -1)
        assert torch.equal(steps["agent"][:, :, 1:][ended], starts[ended])
        went_on = steps["next", "agent"][:, :, :-1][~ended]
        assert torch.equal(steps["agent"][:, :, 1:][~ended], went_on)
    collector.shutdown()


def test_render_shows_the_agent() -> None:
    env = MazeEnv(ROOM)
    step(env, env.reset(), DOWN)
    assert env.render("ansi") == "S.#\nA.G"
    before = env.render(cell=8)
    assert (before.shape, before.dtype) == ((17, 25, 3), torch.uint8)
    env.reset()
    assert env.render("ansi") == "A.#\n..G"
    assert not torch.equal(env.render(cell=8), before)


def test_render_of_a_batch() -> None:
    env = MazeEnv(Level.from_text(["S.G", "G.S", ".SG", "SG."]).reshape(2, 2), max_steps=2)
    assert env.render(cell=8).shape == (2, 2, 9, 25, 3)
    state = env.reset()
    assert env.render("ansi") == ["A.G", "G.A", ".AG", "AG."]
    _, state = env.step_and_maybe_reset(state.set("action", torch.full((2, 2), RIGHT)))
    assert env.render("ansi") == ["SAG", "G.A", ".AG", "AG."]  # the last two were reset


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_environment_moves_to_a_gpu() -> None:
    levels = random_levels(3, 4, 4, 0.2, 0)
    env = MazeEnv(levels).to("cuda")
    env.set_levels(levels.to("cuda"))
    check_env_specs(env, break_when_any_done="both")
    assert env.levels.walls.is_cuda and (env.levels.cpu() == levels).all()


@pytest.mark.parametrize("observe_agent", [False, True])
def test_finished_mazes_are_reset_as_torchrl_resets_them(observe_agent: bool) -> None:
    levels = random_levels(30, 4, 4, 0.2, 3)
    env = MazeEnv(levels, max_steps=5, observe_agent=observe_agent)
    state, ended = env.reset(), 0
    for _ in range(20):
        state = env.step(state.set("action", torch.randint(4, (30,))))
        root = env._step_mdp(state).exclude("action")  # the old one, of no meaning any more
        ended += int(root["done"].sum())
        expected = EnvBase.maybe_reset(env, root.clone())
        state = env.maybe_reset(root)
        assert sorted(state.keys()) == sorted(expected.keys())
        assert (state == expected).all()
        assert torch.equal(env._agent, state["agent"])
    assert ended > 30


def test_new_levels_are_written_where_a_recorded_reset_finds_them() -> None:
    first, second = (random_levels(3, 4, 4, 0.2, seed) for seed in (0, 1))
    env = MazeEnv(first)
    memory = env._next_levels.walls.data_ptr()
    before = env.levels.clone()
    env.set_levels(second)
    assert (env.levels == before).all()
    second.walls.zero_()  # the environment's own are another copy
    env.reset()
    assert (env.levels == random_levels(3, 4, 4, 0.2, 1)).all()
    assert env._next_levels.walls.data_ptr() == memory

"""What an environment shows, takes, pays and tells is read as it is, or refused in a line."""

from __future__ import annotations

import warnings
from contextlib import nullcontext
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from tensordict import TensorDict

from proposer_rl.streams import Streams
from proposer_rl.tasks.gymnasium.environment import (
    SuccessSettings,
    UnfitEnvironmentError,
    read_attribute,
    write_attribute,
)
from proposer_rl.tasks.gymnasium.networks import NetworkSettings
from proposer_rl.tasks.gymnasium.player import (
    GymLevel,
    LevelPlayer,
    MakeEnvironment,
    ParameterSettings,
)
from proposer_rl.tasks.gymnasium.spaces import Layout
from tests.tasks.gymnasium.odd import LIMIT, Line, Robot, odd, with_parts
from tests.tasks.gymnasium.toys import walk_task

TOLD = SuccessSettings(kind="info", key="is_success")
GOAL = {"goal": ParameterSettings(values=[1.0, 3.0], target=3.0)}
ARRAY = np.array([True])


def line_task(env_id: str, **changed: Any) -> Any:
    return walk_task(**{"env_id": env_id, "parameters": GOAL, "success": TOLD, **changed})


def shows(seen: Any, space: Any = Line.observation_space) -> dict[str, Any]:
    return {"observation_space": space, "seen": lambda self: seen}


def steps(*first: Any, info: Any = None) -> dict[str, Any]:
    """Steps that return these numbers in place of the reward and the ends."""

    def step(self: Line, action: Any) -> Any:
        own = Line.step(self, action)
        return (own[0], *first, *own[1 + len(first) : 4], own[4] if info is None else info)

    return {"step": step}


def sets_back(self: Line) -> None:
    self.goal = 2.0


BYTES, PAIR = spaces.Box(0, 255, (2,), np.uint8), (spaces.Discrete(2), spaces.Box(0, 1, (1,)))
MISREAD: list[tuple[dict[str, Any], str]] = [
    # The reset's only array of two, and a step of old Gym's.
    ({"reset": lambda self, **o: Line.reset(self, **o)[0]}, "env_id=Odd.*float32 .*space is Box"),
    ({"step": lambda self, a: (*Line.step(self, a)[:3], {})}, "env_id=Odd.*step raises ValueError"),
    (steps(None), "env_id=Odd.*step raises TypeError"),
    ({"step": lambda self, a: 1 / 0}, r"env_id=Odd.*step raises ZeroDivisionError: .*"
     r"\(test_trial.py, line \d+\), on the level goal=3, seed=\d+"),
    (shows({"a": "abc"}, spaces.Dict({"a": spaces.Text(3)})),
     "no network for Text.*its part a; .*FilterObservation"),
    ({"action_space": spaces.Tuple(PAIR)}, "action space Tuple.*there is a policy for"),
    (steps(info={"is_success": "False"}), "success.key=is_success.*not 'False'"),
    (steps(info={"is_success": 0.3}), "success.key=is_success.*not 0.3"),
    (steps(info={"is_sucess": True, "a": {"b": 1}}), "it has: is_sucess, a, a.b; "),
    ({"goal": property(lambda self: 3.0)}, "parameters.goal: AttributeError: property 'goal'"),
    ({"reset": lambda self, **o: (sets_back(self), Line.reset(self, **o))[1]},
     "parameters.goal: goal of Odd is 2.0, not 1, after a reset and a step"),
    ({"step": lambda self, a: (sets_back(self), Line.step(self, a))[1]},
     "parameters.goal: goal of Odd is 2.0, not 1, after a reset and a step"),
]  # fmt: skip


@pytest.mark.filterwarnings("ignore")  # of check_env
@pytest.mark.parametrize(("members", "message"), MISREAD)
def test_what_would_be_misread_is_refused(members: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        line_task(odd(**members))
    assert "\n" not in str(caught.value)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "members",
    [
        steps(np.array([0.5], np.float32)),
        steps(torch.tensor(0.5)),
        *(steps(info={"is_success": one}) for one in (ARRAY, np.bool_(True), 1, np.array(1.0))),
        {"seen": lambda self: [self.x, 3]},
        {"step": lambda self, a: (*Line.step(self, a)[:2], ARRAY, np.array(0), {"is_success": 1})},
    ],
)
def test_one_number_in_another_dress_is_that_number(members: dict[str, Any]) -> None:
    player = LevelPlayer(line_task(odd(**members))._make, GOAL, GymLevel({"goal": 3.0}, 0), TOLD)
    player.reset()
    played = [player.step(1) for _ in range(LIMIT)]
    reward, ended = played[-1][1:3]
    assert type(reward) is float and type(ended) is bool
    assert any("success" in step[4] for step in played)


def test_a_nested_or_optional_entry_of_the_info_can_tell_success() -> None:
    deep = line_task(odd(), success=SuccessSettings(kind="info", key="deep.won"))
    assert deep.measure(deep.learner([Streams(0)]).agent)["target_success"] >= 0
    only = {"step": lambda self, a: (*Line.step(self, a)[:4], {"won": 1} if self.x > 3 else {})}
    with pytest.raises(ValueError, match="set success"):
        line_task(odd(**only), success=SuccessSettings(kind="info", key="won"))
    line_task(odd(**only), success=SuccessSettings(kind="info", key="won", optional=True))


NEVER_OVER = {"step": lambda self, a: (*Line.step(self, 0)[:4], {})}


def test_survival_is_the_time_limit_and_nothing_else() -> None:
    """An environment that cuts an episode off by itself has not let it survive."""
    cut = odd(step=lambda self, a: (*Line.step(self, a)[:2], False, self.t >= 5, {}))
    rule = SuccessSettings(kind="survived")
    with pytest.warns(UserWarning, match="cut an episode off after 5 steps, before the time limit"):
        task = line_task(cut, success=rule)
    whole = line_task(odd(**NEVER_OVER), success=rule)
    for made, survives in ((task, 0.0), (whole, 1.0)):
        agent = made.learner([Streams(0)]).agent
        assert made.measure(agent)["target_success"] == survives


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "wrapper",
    [
        {"gymnasium.wrappers.TimeLimit": {"max_episode_steps": 5}},
        {"gymnasium.wrappers.MaxAndSkipObservation": {"skip": 5}},
    ],
)
def test_a_wrapper_may_hold_the_time_limit_or_take_several_steps_at_once(wrapper: Any) -> None:
    """The limit of 12 steps ends an episode at the third action where each is taken five times."""
    rule = SuccessSettings(kind="survived")
    task = line_task(odd(**NEVER_OVER), success=rule, wrappers=[wrapper])
    assert task.measure(task.learner([Streams(0)]).agent)["target_success"] == 1.0


KINDS = odd(__init__=with_parts)


@pytest.mark.parametrize(
    "path",
    ["gravity.2", "gravity.-1", "mass", "sizes.1", "config.wind.power", "on", "opt.gravity.2"],
)
def test_a_number_gets_to_where_its_path_leads(path: str) -> None:
    environment = gymnasium.make(KINDS).unwrapped
    kind = type(read_attribute(environment, path))
    write_attribute(environment, path, 0.0)
    assert (
        float(read_attribute(environment, path)) == 0.0
        and type(read_attribute(environment, path)) is kind
    )
    assert environment.gravity[:2].tolist() == [0.0, 0.0]  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("gravity", r"is array\(.*, no place for 0.5; .*, as in name: gravity.0"),
        ("sizes", r"is \[1.0, 2.0\], no place for 0.5; name one of its parts"),
        ("gravity.3", "has no attribute 'gravity.3'"),
        ("config.wind.force", "has no attribute 'config.wind.force'; numbers that it has"),
        ("config", "config is {.*, no place for 0.5$"),
        ("kind", "kind is 'dry', no place for"),
        ("step", "no place for 0.5"),
        ("on", "on of Odd is True, not 0.5"),
        ("counts.0", "is 0, not 0.5"),
    ],
)
def test_what_cannot_hold_the_number_refuses_it(path: str, message: str) -> None:
    with pytest.raises(UnfitEnvironmentError, match=message):
        write_attribute(gymnasium.make(KINDS).unwrapped, path, 0.5)


def test_what_is_only_passed_on_is_not_set_beside_it() -> None:
    environment: Any = gymnasium.make("PassesOn-v0").unwrapped
    with pytest.raises(UnfitEnvironmentError, match="only passes 'drag' on"):
        write_attribute(environment, "drag", 0.5)
    write_attribute(environment, "inner.drag", 0.5)
    assert environment.drag == 0.5


KEEPS = "with it the same actions .* keeps running stat"


@pytest.mark.parametrize(
    ("name", "message"),
    [("NormalizeObservation", KEEPS), ("NormalizeReward", KEEPS),
     ("FilterObservation", "TypeError: .*filter_keys")],
)  # fmt: skip
def test_a_wrapper_that_spoils_it_is_blamed(name: str, message: str) -> None:
    wrapper = f"gymnasium.wrappers.{name}"
    with pytest.raises(ValueError, match=f"wrappers: {wrapper}: {message}"):
        line_task(odd(), wrappers=["gymnasium.wrappers.RecordEpisodeStatistics", wrapper])


def test_wrappers_that_begin_anew_with_each_episode_are_welcome() -> None:
    stack: Any = {"gymnasium.wrappers.FrameStackObservation": {"stack_size": 3}}
    named = ["TimeAwareObservation", "RecordEpisodeStatistics"]
    task = line_task(odd(), wrappers=[*(f"gymnasium.wrappers.{name}" for name in named), stack])
    env = task.learner([Streams(0)]).env
    assert env.observation_spec["observation"].shape == (1, 4, 9)  # 3 times x, the goal, the time


DRAWS = {"metadata": {"render_modes": ["rgb_array"]}}


def hill(colour: int) -> dict[str, Any]:
    """A hill too far away for a short episode, which is there to be seen if it has a colour."""
    return {
        **DRAWS,
        "hill": 1.0,
        "render": lambda self: np.full((8, 8, 3), colour * self.hill, np.uint8),
    }


HILL = {"hill": ParameterSettings(values=[1.0, 3.0], target=3.0)}
NOISE = {"seen": lambda self: np.array([np.random.normal(), self.goal], np.float32)}
IGNORED = {"typo": ParameterSettings(set="option", values=[0, 1], target=0)}
DOUBTED: list[tuple[Any, Any, str | None]] = [
    ({}, IGNORED, "parameters.typo: .* may not read this parameter"),
    ({}, GOAL, None),
    (hill(0), HILL, "parameters.hill: .* may not read this parameter"),
    (hill(50), HILL, None),
    (NOISE, GOAL, "check_env: .* is non-deterministic"),
    ({"reset": lambda self, seed=None, options=None: Line.reset(self)}, GOAL, "check_env: "),
]  # fmt: skip


@pytest.mark.parametrize(("members", "parameters", "message"), DOUBTED)
def test_what_may_be_meant_otherwise_is_told(
    members: Any, parameters: Any, message: str | None
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore" if message else "error")  # Gymnasium warns of others, too
        with pytest.warns(UserWarning, match=message) if message else nullcontext():
            line_task(odd(**members), parameters=parameters)


def test_a_time_limit_of_its_own_is_the_time_limit() -> None:
    """Also where the episode of the trial ends before it."""
    inside = odd(step=lambda self, a: (*Line.step(self, 0)[:4], {}))
    name = f"Limited{inside}"
    gymnasium.register(
        name, lambda **given: TimeLimit(gymnasium.make(inside, **given).unwrapped, 5),
        max_episode_steps=LIMIT,
    )  # fmt: skip
    task = line_task(name, success=SuccessSettings(kind="survived"))
    assert (
        task.max_steps == 5 and task.measure(task.learner([Streams(0)]).agent)["all_success"] == 1
    )


SMALL = spaces.Box(-9, 9, (2,), np.int32)
IMAGE, GREY = (spaces.Box(0, 255, shape, np.uint8) for shape in ((20, 24, 3), (20, 24)))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("space", "seen"),
    [
        (BYTES, np.array([0, 255])),
        (BYTES, [0.0, 255.0]),
        (SMALL, np.array([-9.0, 3.0])),
        (IMAGE, np.arange(20 * 24 * 3).reshape(20, 24, 3) % 256),
        (GREY, np.arange(20 * 24).reshape(20, 24) % 256),
        (spaces.Dict({"a": GREY, "b": GREY}), {"a": np.ones((20, 24)), "b": np.ones((20, 24))}),
    ],
)
def test_whole_numbers_of_another_type_are_seen_as_they_are(space: Any, seen: Any) -> None:
    network = NetworkSettings(hidden=[8], channels=None if space.shape == (2,) else [4])
    task = line_task(odd(**shows(seen, space)), network=network)
    state = task.environment(task.target.sample(2, torch.Generator())).reset()
    shown = seen.values() if isinstance(seen, dict) else [seen]
    names = [f"image {name}" for name in seen] if isinstance(seen, dict) else ["observation"]
    for name, part in zip(names, shown, strict=True):
        assert np.array_equal(state[name][1].numpy().squeeze(), part)


CHOICE, CHOICES, BITS = spaces.Discrete(5), spaces.MultiDiscrete([5, 5]), spaces.MultiBinary(2)
BOXED = spaces.Dict({"a": spaces.Box(-1, 1, (2,)), "b": CHOICE})
LATER: list[tuple[Any, Any, Any]] = [
    (BYTES, np.array([1, 2]), np.array([1, 256])),
    (Line.observation_space, np.ones(2), np.ones(3)),
    (Line.observation_space, np.ones(2), ["a", "b"]),
    (CHOICE, 1, 5),
    (CHOICES, np.array([1, 2]), np.array([1, -2])),
    (BITS, np.array([0, 1]), np.array([0, 2])),
    (BOXED, {"a": np.ones(2), "b": 1}, {"a": np.ones(3), "b": 1}),
]


@pytest.mark.parametrize(("space", "first", "later"), LATER)
def test_what_a_space_cannot_hold_is_also_refused_after_the_trial(
    space: Any, first: Any, later: Any
) -> None:
    player = LevelPlayer(
        MakeEnvironment(odd(**shows(first, space))), GOAL, GymLevel({"goal": 3.0}, 0)
    )
    player.reset()
    player.unwrapped.seen = lambda: later  # type: ignore[attr-defined]
    message = r"the environment shows .*; its observation space is .*, on the level goal=3, seed=0"
    for act in (player.reset, lambda: player.step(0)):
        with pytest.raises(UnfitEnvironmentError, match=message):
            act()


@pytest.mark.parametrize("vectorization", ["sync", "async"])
def test_what_fails_after_the_trial_names_the_level(vectorization: Any) -> None:
    """The environment is as it should be until it has been stepped often."""

    def step(self: Any, action: Any) -> Any:
        self.total = getattr(self, "total", 0) + 1
        seen, *rest = Line.step(self, action)
        if self.total > 3 * LIMIT and self.goal == 1.0:
            raise RuntimeError("it has\nexploded")
        if self.total > 3 * LIMIT and self.goal == 2.0:
            rest[0] = 1e300  # beyond float32
        elif self.total > 3 * LIMIT:
            seen = seen * np.nan
        return seen, *rest

    task = line_task(odd(step=step), vectorization=vectorization)
    for goal, said in (
        (1.0, "step raises RuntimeError: it has exploded"),
        (2.0, "reward: NaN or infinity, or a number beyond float32"),
        (3.0, "observation: Na"),
    ):
        level = TensorDict({"goal": torch.tensor([[goal]]), "seed": torch.tensor([[7]])}, [1, 1])
        env = task.environment(level)
        with pytest.raises(UnfitEnvironmentError, match=f"{said}.* level goal={goal:g}, seed=7$"):
            env.rollout(5 * LIMIT, break_when_any_done=False)
        env.close()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "members",
    [
        {**DRAWS, "__init__": lambda self: Line.__init__(self)},
        {**DRAWS, "render": lambda self: np.zeros((4, 4, 3))},
        {**DRAWS, "render": lambda self: None},
        {"metadata": {}},
    ],
)
def test_without_pictures_it_trains_all_the_same(members: dict[str, Any]) -> None:
    task = line_task(odd(**members))
    assert "no frames" in task.key and task.record(task.target.sample(1, torch.Generator()), None)


def test_pictures_that_fail_later_become_numbers() -> None:
    def render(self: Any) -> Any:
        if self.goal == 1.0:
            raise RuntimeError("no display any more")
        return np.zeros((4, 4, 3), np.uint8)

    task = line_task(odd(**DRAWS, render=render))
    levels = task.space.generate(torch.tensor([[1, 0, 1]]), [Streams(0).generator()])[0]
    first, failed, _ = task.record(levels, None)
    assert first["picture"] != failed["picture"]


def test_actions_arrive_as_they_were_meant() -> None:
    """Bounded parts are scaled, half bounded ones clipped, unbounded ones stay as they are."""
    layout = Layout(Robot.observation_space, Robot.action_space)
    assert layout.acts.shape == (4,)
    for action, taken in (
        ([0.5, 0.5, 0.5, -3.0], [2.5, 0.5, 0.5, -3.0]),
        ([2.0, -0.5, 0.0, 7.0], [4.0, 0.0, 0.0, 7.0]),
    ):
        own = layout.taken(torch.tensor(action))
        assert np.concatenate([own[0], own[1][0]]).tolist() == taken
        assert Robot.action_space.contains(own)
    single = Layout(Robot.observation_space, spaces.Tuple((spaces.Discrete(2, start=3),)))
    assert single.acts.shape == (1,)
    assert single.taken(torch.tensor([[1], [0]]))[0].tolist() == [4, 3]


def of(name: str, *values: float) -> dict[str, Any]:
    """An environment of an argument's values, in which episodes that end are successes."""
    given = ParameterSettings(set="argument", name=name, values=[*values], target=values[-1])
    rule = SuccessSettings(kind="terminated")
    return {"parameters": {"a": given}, "success": rule, "max_steps": 8}


ROOM = {"wrappers": ["minigrid.wrappers.ImgObsWrapper"], **of("size", 5, 6)}
LEARNT: list[tuple[str, list[int] | None, int | None, dict[str, Any]]] = [
    *((f"tests.tasks.gymnasium.odd:{name}-v0", channels, memory, {})
      for name, channels in (("Grey", [4]), ("Mixed", [4]), ("Robot", None))
      for memory in (None, 8)),
    ("MountainCarContinuous-v0", None, None, of("goal_velocity", 0.0)),
    ("minigrid:MiniGrid-Empty-5x5-v0", [4], None, ROOM),
]  # fmt: skip


@pytest.mark.parametrize(("env_id", "channels", "memory", "more"), LEARNT)
def test_of_all_spaces_it_learns_with_memory_and_without(
    env_id: str, channels: Any, memory: int | None, more: Any
) -> None:
    network = NetworkSettings(hidden=[8], channels=channels, memory=memory)
    task = line_task(env_id, network=network, **more)
    learner = task.learner([Streams(0), Streams(1)])
    before = learner.snapshot()
    levels = task.target.sample(8, Streams(0).generator()).reshape(2, 4)
    learner.env.set_levels(levels)
    rollout, _ = learner.update([Streams(copy).generator() for copy in range(2)])
    learner.check()
    assert not (learner.snapshot() == before).all()
    if channels is None:  # continuous actions
        assert rollout["action"].shape == (2, 4, 8, *task._acts.shape)
        assert rollout["action"].std() > 0.3
    assert task.measure(learner.agent).batch_size == (2,)
    assert task.probe(learner.agent, levels[0]).shape[:2] == (2, 4)
    alone = task.learner([Streams(0)])
    assert alone.agent.distribution_class is learner.agent.distribution_class


def test_memory_is_that_of_one_episode() -> None:
    """What a Solver does at the beginning of an episode does not depend on the one before."""
    network = NetworkSettings(hidden=[8], memory=8)
    short = odd(step=lambda self, a: (*Line.step(self, a)[:2], self.t >= 3, False, {}))
    task = line_task(short, network=network, success=SuccessSettings(kind="terminated"))
    learner = task.learner([Streams(0)])
    learner.env.set_levels(task.target.sample(4, Streams(0).generator()).unsqueeze(0))
    rollout = learner.collect([Streams(1).generator()])
    begins = rollout["is_init"].squeeze(-1)
    assert begins[0, 0].tolist() == [True, False, False, True, False, False, True, False]
    values = rollout["state_value"].squeeze(-1)
    torch.testing.assert_close(values[..., 0], values[..., 3])
    assert not torch.allclose(values[..., 0], values[..., 1])

"""Environments of Gymnasium as tasks: wrong input, pictures, and the commands."""

from __future__ import annotations

import base64
import io
import json
import re
import shlex
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from PIL import Image

from proposer_rl.cli.build import make_task
from proposer_rl.extras import install_command
from proposer_rl.runs.folder import read_csv
from proposer_rl.runs.records import TaskFacts, checked
from proposer_rl.streams import Streams
from proposer_rl.tasks.gymnasium import pictures
from proposer_rl.tasks.gymnasium.player import (
    GymLevel,
    LevelPlayer,
    MakeEnvironment,
    ParameterSettings,
)
from tests.tasks.gymnasium.odd import Line, odd
from tests.tasks.gymnasium.toys import NO_BOX2D, PARAMETERS, TINY, WALK, Walk, walk_task
from tests.test_readme import ROOT, commands, write_files
from tests.tiny import composed


def picture(record: dict[str, Any]) -> np.ndarray:
    file = io.BytesIO(base64.b64decode(record["picture"]))
    return np.asarray(Image.open(file).convert("RGB")).astype(int)


def one(**given: Any) -> dict[str, Any]:
    """A parameter ``a`` of a single value."""
    return {"parameters": {"a": ParameterSettings(**{"values": [1], "target": 1, **given})}}


HERE = "tests.tasks.gymnasium.test_task"
NEGATIVE = ParameterSettings(set="argument", low=-1.0, high=2.0, bins=2, target=1.0)
SIZES = ParameterSettings(set="argument", values=[3, 5], target=3)
WRONG: list[tuple[dict[str, Any], str]] = [
    ({"env_id": "Nowhere-v0"}, r"env_id=Nowhere-v0: Environment `Nowhere` doesn't.*module:Name"),
    ({"env_id": "nowhere:Walk-v0"},
     "env_id=nowhere:Walk-v0: No module named 'nowhere'.*cannot find it: install it there"),
    ({"parameters": {"seed": PARAMETERS["width"]}}, "parameters.seed: is a column of training.csv"),
    (one(), "parameters.a: Walk has no attribute 'a'; numbers that it has: width, wind"),
    ({"parameters": {"width": NEGATIVE}},
     r"env_id=.*: the constructor raises ValueError: width .*\(toys.*level width=-1, seed=\d+"),
    (one(set="call", name="nowhere.f"),
     "parameters.a: 'nowhere.f' cannot be imported: No module named 'nowhere'$"),
    ({"wrappers": [f"{HERE}.with_whole_actions"]},
     r"action space Box.*int64\): there is a policy for .* a Box of floats"),
    ({"env_id": "tests.tasks.gymnasium.broken:Walk-v0", "parameters": {}},
     r"env_id=.*: the constructor raises ZeroDiv.* \(broken.py, line \d+\), on the level"),
    ({"arguments": {"foo": 1}}, "env_id=.*: the constructor raises TypeError: .*unexpected"),
    ({"env_id": f"{HERE}:Grown-v0", "parameters": {"size": SIZES}},
     "parameters.size: all levels must have the same spaces, but 5 changes"),
    ({"env_id": f"{HERE}:Endless-v0"}, "max_steps: missing"),
]  # fmt: skip


@pytest.mark.parametrize(("changed", "message"), WRONG)
def test_wrong_input_is_told_in_a_line(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        walk_task(**changed)
    assert "\n" not in str(caught.value)


def with_whole_actions(env: Any) -> Any:
    whole = gymnasium.spaces.Box(1, 2, (1,), np.int64)
    return gymnasium.wrappers.TransformAction(env, lambda action: int(action[0]), whole)


def as_dictionary(env: Any) -> Any:
    return gymnasium.wrappers.TransformObservation(
        env, lambda seen: {"a": seen}, gymnasium.spaces.Dict({"a": env.observation_space})
    )


gymnasium.register("Endless-v0", Walk)


class Grown(gymnasium.Env[Any, Any]):
    """Shows as many numbers as it is asked for."""

    def __init__(self, size: int, render_mode: str | None = None) -> None:
        self.observation_space = gymnasium.spaces.Box(-1, 1, (size,))
        self.action_space = gymnasium.spaces.Discrete(2)

    def reset(self, **_: object) -> tuple[Any, dict[str, Any]]:
        return np.zeros(self.observation_space.shape, np.float32), {}

    def step(self, action: int) -> Any:
        return self.reset()[0], 0.0, False, False, {}


gymnasium.register("Grown-v0", Grown, max_episode_steps=5)


def test_a_missing_extra_is_told_with_its_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def make(*_: object, **__: object) -> None:
        raise gymnasium.error.DependencyNotInstalled("Box2D is not installed")

    monkeypatch.setattr(gymnasium, "make", make)
    line = install_command("box2d")
    with pytest.raises(ValueError) as caught:
        walk_task(extra="box2d")
    assert line in str(caught.value) and "Box2D is not installed" in str(caught.value)


def test_processes_change_no_numbers() -> None:
    measured = []
    for vectorization in ("sync", "async"):
        task = walk_task(vectorization=vectorization)
        learner = task.learner([Streams(0)])
        learner.env.set_levels(task.target.sample(4, Streams(0).generator()).unsqueeze(0))
        learner.update([Streams(1).generator()])
        measured.append(task.measure(learner.agent))
        learner.env.close()
    assert (measured[0] == measured[1]).all()


def test_what_the_environment_needs_can_be_put_around_it() -> None:
    task = walk_task(wrappers=[f"{HERE}.as_dictionary", "gymnasium.wrappers.FlattenObservation"])
    assert task.learner([Streams(0)]).env.observation_spec["observation"].shape == (1, 4, 2)


def test_statistics_and_returns_are_those_of_the_environment() -> None:
    task = walk_task()
    learner = task.learner([Streams(0)])
    levels = task.space.sample(4, Streams(1).generator()).unsqueeze(0)
    learner.env.set_levels(levels)
    rollout = learner.collect([Streams(2).generator()])
    told = task.training_metrics(levels, rollout)
    first = [row.tolist().index(True) + 1 for row in rollout["next", "done"][0].squeeze(-1)]
    rewards = rollout["next", "reward"][0].squeeze(-1)
    returns = [float(row[:end].sum()) for row, end in zip(rewards, first, strict=True)]
    assert float(told["train_return"][0]) == pytest.approx(np.mean(returns), rel=1e-5)
    assert float(told["speed"][0]) == pytest.approx(float(levels["speed"].mean()))


@pytest.mark.parametrize(
    "failure", [None, gymnasium.error.DependencyNotInstalled("pygame"), RuntimeError("no OpenGL")]
)
def test_pictures_show_the_level_and_the_episode(
    failure: Exception | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = failure is None
    if failure is not None:

        def render(self: object) -> None:
            raise failure

        monkeypatch.setattr(pictures.LevelPlayer, "render", render)
    task: Any = make_task(composed("task=cartpole", "+method=target", *TINY))
    learner = task.learner([Streams(0)])
    choices = torch.tensor([[0, task.space.size - 1, 0, 0]])
    levels = task.space.generate(choices, [Streams(0).generator()])
    learner.env.set_levels(levels)
    rollout = learner.collect([Streams(2).generator()])
    still, moved = task.record(levels[0], None), task.record(levels[0], rollout[0])
    assert max(picture(still[0]).shape[:2]) == pictures.LONGER_SIDE
    assert not np.array_equal(picture(still[0]), picture(still[1]))
    assert (task.facts["key"] == pictures.FRAMES) is drawn
    assert np.array_equal(picture(still[0]), picture(moved[0])) is not drawn
    assert still[0]["text"][0] == "half length 0.1"
    assert still[0]["level"]["seed"] == int(levels["seed"][0, 0])


@pytest.mark.parametrize(
    ("name", "shape", "answers"),
    [
        ("cartpole", (4,), 2),
        pytest.param("lunar_lander", (8,), 4, marks=NO_BOX2D),
        ("minigrid", (7, 7, 3), 7),
        ("multiroom", (7, 7, 3), 7),
        pytest.param("bipedal_stumps", (24,), 4, marks=NO_BOX2D),
        ("half_cheetah", (17,), 6),
    ],
)
def test_the_tasks_that_come_along(name: str, shape: tuple[int, ...], answers: int) -> None:
    task: Any = make_task(composed(f"task={name}", "+method=target", *TINY))
    learner = task.learner([Streams(0)])
    levels = task.target.sample(4, Streams(1).generator())
    learner.env.set_levels(levels.unsqueeze(0))
    rollout = learner.collect([Streams(2).generator()])
    assert rollout["observation"].shape == (1, 4, 12, *shape)
    assert task.probe(learner.agent, levels).shape == (1, 4, answers)
    if name == "half_cheetah" and task.key == pictures.NO_FRAMES:
        pytest.skip("MuJoCo draws nothing here: there is no display, and no EGL")
    start, later = task.record(levels[:1], None), task.record(levels[:1], rollout[0, :1])
    assert picture(start[0]).std() > 1 and not np.array_equal(picture(start[0]), picture(later[0]))
    assert float(task.target_shares.sum()) == pytest.approx(1)


METHODS = [
    "perf_gain", "domain_randomization", "plr", "alp_gmm", "model_transport", "currot",
    "learning_progress curriculum.source=episodes", "sfl +score=sampled",
    "paired solver.ppo.continue_episodes=false",
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.usefixtures("own_folder")
@pytest.mark.parametrize("method", METHODS)
def test_curricula_run_from_the_command_line(method: str, train: Any) -> None:
    assert train("task=cartpole", *f"+method={method}".split(), *TINY, "hydra.run.dir=run") == 0
    rows = read_csv(Path("run/metrics.csv"))
    assert [row["updates"] for row in rows] == [0, 2, 4]
    assert {"target_success", "target_return", "all_success", "all_return"} <= rows[0].keys()
    told = json.loads(Path("run/run.json").read_text())["task"]
    assert told["title"] == "CartPole-v1" and told["exact"] is False


@pytest.mark.usefixtures("own_folder")
def test_the_files_that_the_page_shows_are_all_that_is_needed(
    train: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (ROOT / "docs/how_to/gymnasium_environment.md").read_text(encoding="utf-8")
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    write_files(readme, Path())
    write_files(page, Path())
    module = re.search(r"```python\n(.*?gymnasium\.register\(.*?\n)", page, re.DOTALL)
    assert module is not None
    Path("corridor.py").write_text(module[1], encoding="utf-8")
    for name in ("hill", "corridor"):
        every = [*commands(page), *commands(readme)]
        _, *words = next(words for words in every if f"task={name}" in words)
        words = [word for word in words if word != "bin/train"]
        if name == "corridor":
            assert train(*words, *TINY, "hydra.run.dir=none") == 2  # it is not found
            monkeypatch.syspath_prepend(".")
        assert train(*words, *TINY, f"hydra.run.dir={name}") == 0
    told = json.loads(Path("hill/run.json").read_text())["task"]
    assert told["title"] == "MountainCar-v0"
    assert told["space"] == {"force": pytest.approx([0.001, 0.002, 0.003, 0.004])}


def test_levels_can_be_seeds_alone_of_separate_sets() -> None:
    task = walk_task(parameters={}, train_seeds=3)
    trained = task.space.sample(200, Streams(0).generator())["seed"]
    assert set(trained.tolist()) == {0, 1, 2} >= set(task.evaluated_on["train"]["seed"].tolist())
    assert (task.evaluated_on["target"]["seed"] >= 3).all()
    assert set(task.target.sample(200, Streams(0).generator())["seed"].tolist()) == {0, 1, 2}
    learner = task.learner([Streams(0)])
    assert {"train_success", "target_success"} <= set(task.measure(learner.agent).keys())
    learner.env.set_levels(task.space.generate(torch.zeros(1, 4).long(), [torch.Generator()]))
    learner.update([Streams(1).generator()])
    (record,) = task.record(task.target.sample(1, torch.Generator()), None)
    assert record["level"].keys() == {"seed"}


def test_single_levels_are_of_the_seeds_that_are_measured_on() -> None:
    """The environment pays for the seeds below 3 alone."""

    def reset(self: Any, *, seed: Any = None, options: Any = None) -> Any:
        self.pays = float(seed < 3)
        return Line.reset(self, seed=seed)

    paying = odd(reset=reset, step=lambda self, a: (self.seen(), self.pays, False, False, {}))
    task = walk_task(env_id=paying, parameters={}, train_seeds=3)
    agent = task.learner([Streams(0)]).agent
    for name, trained in (("train", True), ("target", False), ("all", False)):
        results = [one.results["return"] for one in task.level_results(agent, name, None)]
        assert results and {value > 0 for value in results} == {trained}


def test_single_levels_are_those_of_the_last_row_of_the_metrics() -> None:
    task = walk_task()
    agent = task.learner([Streams(0), Streams(1)]).agent
    measured = task.measure(agent)
    for name in task.evaluated_on:
        rows = task.level_results(agent, name, None)
        for result in task.results:
            for solver in (0, 1):
                mean = np.mean([row.results[result] for row in rows if row.solver == solver])
                assert mean == pytest.approx(float(measured[f"{name}_{result}"][solver]))


def test_one_parameter_can_set_several_numbers() -> None:
    both = ParameterSettings(name=["engine.speed", "wind"], values=[0.5, 1.0], target=1.0)
    player = LevelPlayer(MakeEnvironment(WALK), {"both": both}, GymLevel({"both": 0.5}, 0))
    player.reset()
    inner: Any = player.unwrapped
    assert (inner.engine.speed, inner.wind) == (0.5, 0.5)


@pytest.mark.filterwarnings("ignore:parameters")  # none of the options is read
def test_many_parameters_and_values_are_described_in_short() -> None:
    one = ParameterSettings(set="option", low=0.125, high=0.375, target=[0.1875, 0.3125])
    many = ParameterSettings(set="option", values=list(range(200)), target=list(range(150)))
    task = walk_task(
        env_id=odd(), parameters={f"number {i}": one for i in range(17)} | {"track": many}
    )
    told = checked(TaskFacts, task.facts, "task")
    assert len(told.space) == 18 and len(told.space["track"]) == 200
    assert told.about["Target"].startswith("number 0 0.1875 to 0.3125; number 1 0.1875 to")
    assert told.about["Target"].endswith("...") and len(told.about["Target"]) <= 400


class Crates(Line):
    """Says of what it is, in what it shows; a step costs nothing."""

    def __init__(self, material: str = "wood", wet: Any = False, render_mode: Any = None) -> None:
        if material not in ("wood", "steel", "glass") or type(wet) is not bool:
            raise ValueError(f"no crate of {material!r}, {wet!r}")
        super().__init__(render_mode)
        self.place = float(["wood", "steel", "glass"].index(material) + 3 * wet)

    def seen(self) -> Any:
        return np.array([self.x, self.place], np.float32)


gymnasium.register("Crates-v0", Crates, max_episode_steps=5)


def crates(*materials: str) -> dict[str, ParameterSettings]:
    given = {"material": {"values": [*materials], "target": materials[-1]}}
    given["wet"] = {"values": [True, False], "target": True}
    return {name: ParameterSettings(set="argument", **own) for name, own in given.items()}


def test_texts_and_truth_values_are_set_tried_and_shown_as_they_are() -> None:
    env_id, many = f"{HERE}:Crates-v0", crates("wood", "steel", "glass")
    task = walk_task(env_id=env_id, parameters=many)
    levels = task.space.generate(torch.tensor([[0, 5, 4, 4]]), [Streams(0).generator()])
    shown = task.environment(levels).reset()["observation"][0, :, 1]
    assert shown.tolist() == [3.0, 2.0, 5.0, 5.0]
    records = task.record(levels[0], None)
    assert [one["text"] for one in records[:2]] == [
        ["material wood", "wet True"], ["material glass", "wet False"],
    ]  # fmt: skip
    told = json.loads(json.dumps(records[1]["level"]))
    assert (told["material"], told["wet"]) == ("glass", False)
    facts = checked(TaskFacts, task.facts, "task")
    assert facts.space == {"material": ["wood", "steel", "glass"], "wet": ["True", "False"]}
    assert facts.about["Target"] == "material glass; wet True"
    learner = task.learner([Streams(0)])
    learner.env.set_levels(levels)
    columns = task.training_metrics(levels, learner.collect([Streams(2).generator()]))
    shares = {name: float(columns[name]) for name in columns.keys() if "=" in name}
    assert shares == {
        "material=wood": 0.25, "material=steel": 0, "material=glass": 0.75,
        "wet=True": 0.75, "wet=False": 0.25,
    }  # fmt: skip
    # A belief sees which of them it is, so that none lies between two others.
    assert task.space.inputs(levels[0, :2]).tolist() == [[1, 0, 0, 1, 0], [0, 0, 1, 0, 1]]
    with pytest.raises(ValueError, match=r"no crate .*material=clay, wet=True, seed=\d+"):
        walk_task(env_id=env_id, parameters=crates("wood", "clay", "glass"))
    others = walk_task(env_id=env_id, parameters=crates("steel", "wood", "glass"))
    assert others.facts["measured"] != task.facts["measured"]


@pytest.mark.parametrize(
    "method",
    ["accel curriculum.edits=2", "plr task.parameters={} task.train_seeds=5",
     "target task.parameters={}",
     "alp_gmm curriculum.rounded=false '++curriculum={warmup: 4, refit: 4, components: 2}'"],
)  # fmt: skip
@pytest.mark.usefixtures("own_folder")
def test_levels_without_bins_are_trained_on(method: str, train: Any) -> None:
    name, *more = shlex.split(method)
    walk = [
        f"task.env_id={WALK}", "task.success.kind=terminated", *TINY, "hydra.run.dir=run",
        "++task.parameters.engine={name: engine.speed, low: 0.5, high: 1.5, target: [1.0, 1.25]}",
    ]  # fmt: skip
    kept = walk if "task.parameters={}" not in more else walk[:-1]
    assert train("task=gymnasium", f"+method={name}", *kept, *more) == 0
    assert len(read_csv(Path("run/metrics.csv"))) == 3

"""What is asked of every task, of all that there are."""

from __future__ import annotations

import base64
import io
import json
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from PIL import Image

from proposer_rl.cli.build import make_task
from proposer_rl.streams import Streams
from proposer_rl.task import LocatedTarget, Task
from tests.tasks.batched_envs.toys import windy_task
from tests.tasks.gymnasium.toys import walk_task
from tests.tiny import composed, mountain_cars, point_masses, sledges, tiny_task, tiny_view_task

K, P, C, E = 2, 4, 3, 5


TASKS = {
    "mazes": tiny_task,
    "cars": mountain_cars,
    "sledges": sledges,
    "walk": walk_task,
    "views": tiny_view_task,
    "gates": point_masses,
    "wind": windy_task,
    "robots": lambda: make_task(
        composed("task=robots", "+method=target", "solver.batch_size=4", "solver.ppo.horizon=8")
    ),
}


@pytest.fixture(params=TASKS.values(), ids=TASKS, scope="module")
def task(request: pytest.FixtureRequest) -> Task:
    make: Callable[[], Task] = request.param
    return make()


def streams(seed: int = 0) -> list[Streams]:
    return [Streams(seed, copy) for copy in range(K)]


def same(one: Any, other: Any) -> bool:
    return bool((one == other).all())


def test_levels_are_functions_of_their_generator(task: Task) -> None:
    for distribution in (task.target, task.space, *task.distributions.values()):
        one, again, other = (
            distribution.sample(E, Streams(seed).generator()) for seed in (0, 0, 1)
        )
        assert one.batch_size == (E,)
        assert same(one, again) and not same(one, other)


def test_the_space_is_the_product_of_its_axes(task: Task) -> None:
    space = task.space
    assert space.size == math.prod(len(values) for values in space.axes.values())
    assert space.coordinates.shape == (space.size, len(space.axes))
    assert space.coordinates.dtype == torch.float32
    for axis, values in enumerate(space.axes.values()):  # the last one runs fastest
        inner = math.prod(len(v) for v in list(space.axes.values())[axis + 1 :])
        column = space.coordinates[:, axis].reshape(-1, len(values), inner)
        assert (column == column[:1, :, :1]).all()
        assert (column[0, :, 0].diff() > 0).all()


def test_the_target_is_in_the_space(task: Task) -> None:
    assert isinstance(task, LocatedTarget)
    shares = task.target_shares
    assert shares.shape == (task.space.size,) and shares.dtype == torch.float32
    assert (shares >= 0).all() and float(shares.sum()) == pytest.approx(1)


def test_coordinates_fill_the_square(task: Task) -> None:
    found = task.space.coordinates
    torch.testing.assert_close(found.amax(0), torch.ones(found.shape[1]))
    torch.testing.assert_close(found.amin(0), -torch.ones(found.shape[1]))


def test_levels_of_bins_are_each_copys_own(task: Task) -> None:
    choices = torch.arange(K * P).reshape(K, P) % task.space.size
    both = task.space.generate(choices, [s.generator() for s in streams()])
    alone = task.space.generate(choices[1:], [streams()[1].generator()])
    assert both.batch_size == (K, P) and same(both[1:], alone)


def test_a_learner_trains_on_the_levels_that_are_set(task: Task) -> None:
    came = []
    for seed in (0, 0, 1):
        learner = task.learner(streams())
        assert learner.agent.copies == K and learner.env.batch_size == (K, P)
        draws = [s.generator("levels") for s in streams(seed)]
        levels = torch.stack([task.space.sample(P, generator) for generator in draws])
        learner.env.set_levels(levels)
        before = learner.snapshot()
        update = learner.update([s.generator("actions") for s in streams()])
        learner.check()
        assert update.rollout.batch_size == (K, P, learner.settings.horizon)
        assert not same(learner.snapshot(), before)
        came.append((levels, update.rollout, learner.snapshot()))
    assert same(came[0][2], came[1][2]) and not same(came[0][2], came[2][2])
    levels, rollout, _ = came[0]
    metrics = task.training_metrics(levels, rollout)
    assert metrics.batch_size == (K,) and len(list(metrics.keys())) > 0
    for records in (task.record(levels[0], rollout[0]), task.record(levels[0], None)):
        assert len(json.loads(json.dumps(records))) == P
        for record in records:
            picture = Image.open(io.BytesIO(base64.b64decode(record["picture"], validate=True)))
            assert picture.format == "PNG" and min(picture.size) > 8
            picture.load()
            assert all(isinstance(line, str) for line in record.get("text", []))


def test_solvers_are_measured_and_seen(task: Task) -> None:
    agent = task.learner(streams()).agent
    levels = task.target.sample(E, Streams(0).generator())
    with torch.no_grad():
        one, again = (task.performance(agent, levels, Streams(1).generator()) for _ in range(2))
        probes = task.probe(agent, levels[:C])
    assert one.batch_size == (K, E) and one["return"].dtype == torch.float32
    assert same(one, again)
    assert ((one["success"] >= 0) & (one["success"] <= 1)).all()
    own = torch.stack([levels, levels.flip(0)])
    with torch.no_grad():
        each = task.performance(agent, own, Streams(1).generator())
    assert each.batch_size == (K, E) and same(each[0], one[0])
    if task.exact_performance:
        torch.testing.assert_close(each["return"][1].flip(0), one["return"][1])
        assert same(one, task.performance(agent, levels, Streams(2).generator()))
    assert probes.shape[:2] == (K, C) and probes.is_floating_point()
    assert task.probe(agent, levels[:0]).shape == (K, 0, *probes.shape[2:])
    encoder = task.probe_encoder(6)
    assert encoder(probes).shape == (K, C, 6)
    measured = task.measure(agent)
    assert measured.batch_size == (K,) and set(measured.keys()) == set(task.metrics)
    for name, performance in task.evaluate(agent).items():
        assert performance.batch_size[0] == K
        torch.testing.assert_close(performance["success"].mean(1), measured[f"{name}_success"])


def test_a_solver_reaches_the_same_whatever_is_evaluated_with_it(task: Task) -> None:
    """Whatever the other Solvers are, and whatever levels they have."""
    agent, alone = (task.learner(streams()[:copies]).agent for copies in (K, 1))
    levels = task.space.sample(2 * E, Streams(1).generator())

    def performance(of: Any, on: Any, seed: int = 2) -> Any:
        with torch.no_grad():
            return task.performance(of, on, Streams(seed).generator())

    both = performance(agent, levels)
    torch.testing.assert_close(performance(alone, levels)["return"], both["return"][:1])
    own = performance(agent, levels.reshape(K, E))
    for k, some in enumerate((levels[:E], levels[E:])):
        torch.testing.assert_close(own["return"][k], performance(agent, some)["return"][k])
    if not task.exact_performance and both["success"].any():  # else all episodes are alike
        assert not same(performance(agent, levels, 3), both)


def test_evaluation_levels_are_the_same_in_every_run(task: Task) -> None:
    again = type(task).evaluation_levels
    for name, levels in task.evaluated_on.items():
        assert same(again(task, name), levels)


def test_facts_say_what_readers_need(task: Task) -> None:
    facts = json.loads(json.dumps(task.facts))
    assert facts.keys() - {"text_key"} == {
        "title", "levels", "distributions", "space", "about", "key", "measured", "exact",
    }  # fmt: skip
    for name in facts["distributions"]:
        assert f"{name}_success" in task.metrics
    assert list(facts["space"]) == list(task.space.axes)
    assert facts == json.loads(json.dumps(task.facts))

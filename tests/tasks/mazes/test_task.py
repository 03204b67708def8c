"""The maze task: what it refuses, what it measures, and that it waits for no device."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import _disable_current_modes

from proposer_rl.meta.assembly import ProposerSettings
from proposer_rl.meta.rewards import performance_gain, task_difficulty
from proposer_rl.methods import Components, proposer
from proposer_rl.models import Population
from proposer_rl.streams import Streams
from proposer_rl.task import ComputeContext
from proposer_rl.tasks.mazes import Level
from proposer_rl.tasks.mazes.task import (
    DistributionSettings,
    MazeEvaluationSettings,
    MazeSettings,
    MazeTask,
    SpaceSettings,
    UNetSettings,
    faster_precision,
)
from tests.host_reads import NoHostReads
from tests.tiny import TASK, evaluate, learners, tiny_task

SMALL = ProposerSettings(
    rollouts=2, meta_episode_length=2, action_repeat=1, validation_levels=4, probe_levels=2
)


def test_performance_and_metrics_are_those_of_the_exact_evaluator() -> None:
    agent = learners(2).agent
    levels = TASK.target.sample(5, Streams(0).generator())
    assert (TASK.performance(agent, levels, torch.Generator()) == evaluate(agent, levels)).all()
    measured = TASK.measure(agent)
    expected = evaluate(agent, TASK.evaluation_levels("id"))
    for kind in ("success", "return"):
        torch.testing.assert_close(measured[f"id_{kind}"], expected[kind].mean(1))
    # A tenth of eight levels is less than one: the worst.
    torch.testing.assert_close(measured["id_success_worst10"], expected["success"].amin(1))
    assert set(measured.keys()) == set(TASK.metrics)


def test_another_network_takes_the_unets_place() -> None:
    """A Solver of one convolution acts, learns, is measured and is seen by the Proposer."""

    class Convolution(nn.Conv2d):
        def __init__(self) -> None:
            super().__init__(3, 5, 3, padding=1)

        def forward(self, planes: Tensor) -> tuple[Tensor, Tensor]:
            maps = super().forward(planes.flatten(0, -4)).unflatten(0, planes.shape[:-3])
            return maps.split([4, 1], -3)

    unused = UNetSettings(channels=[64, 128, 256, 512])
    own = tiny_task(
        make_network=Convolution, network=unused, context=ComputeContext(precision="auto")
    )
    assert own.precision == "fp32" and named(own, "shapes")
    solvers = own.learner([Streams(0), Streams(1)])
    assert sum(p.numel() for p in solvers.agent.parameters()) == 2 * (3 * 9 + 1) * 5
    before = own.measure(solvers.agent)
    levels = own.target.sample(5, Streams(0).generator())
    probes = own.probe(solvers.agent, levels)
    assert own.probe(solvers.agent, levels[:0]).shape == (2, 0, *probes.shape[2:])
    assert not torch.equal(probes[0], probes[1])
    solvers.update()
    assert (before["id_return"] != own.measure(solvers.agent)["id_return"]).all()


@pytest.mark.parametrize("observe_agent", [False, True])
@pytest.mark.parametrize("reward", [performance_gain, task_difficulty])
def test_a_meta_step_waits_only_to_hear_the_action_and_whether_all_is_finite(
    reward, observe_agent
) -> None:
    maze = tiny_task(maze=replace(TASK.maze, observe_agent=observe_agent))
    trainer = proposer(Components(maze, SMALL, seed=0), reward=reward).trainer
    assert trainer is not None
    env = trainer.env
    for module in env.solvers.agent.modules():
        if isinstance(module, Population):
            module.batched = True

    def on_the_host(function):
        def call(*arguments):
            with _disable_current_modes():
                return function(*arguments)

        return call

    env.actions.levels = on_the_host(env.actions.levels)
    env.solvers.check = on_the_host(env.solvers.check)
    state = env.reset()
    with torch.no_grad():
        for step in range(2):
            state = state.exclude("reward").set("action", env.action_spec.rand())
            if step:  # the first one restores the Solvers, which asks for their Adam steps
                with NoHostReads():
                    env.step(state)
                    maze.measure(env.solvers.agent)
            state = env.step(state)["next"]


def test_metrics_and_records_of_what_was_trained_on() -> None:
    ppo = learners(2)
    levels = TASK.space.generate(
        torch.tensor([[0, 1, 2, 3]] * 2), [Streams(k).generator() for k in (0, 1)]
    )
    ppo.env.set_levels(levels)
    rollout = ppo.collect([Streams(k).generator("actions") for k in (0, 1)])
    metrics = TASK.training_metrics(levels, rollout)
    torch.testing.assert_close(metrics["obstacle_fraction"], torch.full((2,), 0.1))
    torch.testing.assert_close(metrics["path_length"], torch.full((2,), 3.0))
    torch.testing.assert_close(metrics["path_length_sd"], torch.ones(2))
    for k in range(2):
        solved = []
        for record, level in zip(TASK.record(levels[k], rollout[k]), levels[k], strict=True):
            first, *_ = level.to_text().splitlines()
            assert record["text"][0].replace(" ", "").replace("•", ".") == first
            solved.append(record["path"][-1] == level.goal.tolist())
        assert metrics["train_success"][k] == sum(solved) / 4


def test_metrics_of_levels_that_have_no_path_or_too_long_a_one() -> None:
    rows = ["#" * 5] * 4
    near, far, walled = (
        Level.from_text("\n".join(text))
        for text in (
            ["SG...", *rows],
            ["S....", "####.", ".....", ".####", "G...."],  # 12 moves, of at most 8
            ["S#G..", *rows],
        )
    )
    levels = torch.stack([torch.stack([near, far, walled, near]), torch.stack([walled] * 4)])
    ppo = learners(2)
    ppo.env.set_levels(levels)
    metrics = TASK.training_metrics(levels, ppo.collect())
    assert metrics["path_length"].tolist() == pytest.approx([14 / 3, 0])
    variance = (2 * (1 - 14 / 3) ** 2 + (12 - 14 / 3) ** 2) / 3
    assert metrics["path_length_sd"].tolist() == pytest.approx([variance**0.5, 0])
    assert metrics["solvable"].tolist() == [0.5, 0.0]


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"target": "far"}, r"target: must be among \['id'\], got 'far'"),
        ({"evaluation": MazeEvaluationSettings(distributions=["far"], levels=2)},
         r"evaluation.distributions: must be among \['id'\], got 'far'"),
        ({"maze": MazeSettings(height=5, width=5, max_steps=3)},
         "maze.max_steps=3 must be at least 4, the path length of distributions.id"),
        ({"network": UNetSettings(channels=[8] * 4, groups=4)},
         r"maze: 5x5 cells are too few for this Solver: with network.channels=\[8, 8, 8, 8\]"),
        ({"space": SpaceSettings(obstacle_fractions=[0.9], path_lengths=[12])},
         "space: cannot make levels with obstacle_fraction=0.9"),
        ({"distributions": {"id": DistributionSettings(specifications=[(0.9, 8)])}},
         "distributions.id: cannot make levels with obstacle_fraction=0.9"),
    ],
)  # fmt: skip
def test_settings_that_do_not_go_together_are_refused_naming_the_key(parts, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        tiny_task(**parts)


def named(task: MazeTask, name: str, max_steps: int | None = None) -> dict[str, float]:
    """The step limits of a set's levels."""
    scores = task.level_results(learners(1).agent, name, max_steps)
    return {score.level: score.about["max_steps"] for score in scores}


def test_named_levels_get_the_steps_that_they_need(tmp_path) -> None:
    (tmp_path / "halls.txt").write_text("[long]\nS....G\n......\n......\n......\n")
    file = str(tmp_path / "halls.txt")
    assert named(TASK, file) == {"long": 10} and named(TASK, file, 4) == {"long": 4}
    assert set(named(TASK, "ID").values()) == {8}
    agent = learners(1).agent
    usual, *others = (
        [(score.level, score.results) for score in TASK.level_results(agent, name, None)]
        for name in ("id@6x6", "ID@6x6", "id@06x6")
    )
    assert usual[0][0] == "id@6x6_000" and others == [usual, usual]
    shapes = named(TASK, "shapes")
    assert shapes["corridor_8"] == 2 * 34 and min(shapes.values()) >= 8
    with pytest.raises(
        ValueError,
        match="--levels mazes: must be one of: shapes, small, a file ",
    ):
        named(TASK, "mazes")


@pytest.mark.parametrize(
    ("bf16", "device", "channels", "expected"),
    [
        (True, "cpu", [64, 128, 256], "bf16"),
        (True, "cpu", [16, 32, 32], "fp32"),
        (False, "cpu", [64, 128, 256], "fp32"),
        (True, "cuda", [64, 128, 256], "fp32"),
    ],
)
def test_bf16_is_chosen_where_it_was_measured(
    monkeypatch: pytest.MonkeyPatch, bf16, device, channels, expected
) -> None:
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: bf16)
    assert faster_precision(channels, torch.device(device)) == expected

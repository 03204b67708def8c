"""The maze task: its recorded measurements are the plain ones, and wait for no device."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import _disable_current_modes

from benchmarks.results import Options
from benchmarks.scales import TINY
from proposer_rl.mazes.task import EvaluationSettings, MazeTask, SpaceSettings, faster_precision
from proposer_rl.meta.actions import Mixture
from proposer_rl.meta.rewards import performance_gain, task_difficulty
from proposer_rl.methods import Parts, proposer
from proposer_rl.models import Population
from proposer_rl.streams import Streams
from tests.graphs import NoHostReads

OPTIONS = Options(size="tiny", precision="fp32")


def task(observe_agent: bool = False) -> MazeTask:
    return replace(TINY, maze=replace(TINY.maze, observe_agent=observe_agent)).task(OPTIONS)


def test_another_network_takes_the_unets_place() -> None:
    """A Solver of one convolution acts, learns, is measured and is seen by the Proposer."""

    class Convolution(nn.Conv2d):
        def __init__(self) -> None:
            super().__init__(3, 5, 3, padding=1)

        def forward(self, planes: Tensor) -> tuple[Tensor, Tensor]:
            maps = super().forward(planes.flatten(0, -4)).unflatten(0, planes.shape[:-3])
            return maps.split([4, 1], -3)

    own = MazeTask(
        maze=TINY.maze,
        distributions=TINY.distributions,
        target="id",
        space=TINY.space,
        solver=TINY.solver,
        evaluation=EvaluationSettings(distributions=["id"], levels=8),
        network=Convolution,
    )
    solvers = own.solvers([Streams(0), Streams(1)])
    assert sum(p.numel() for p in solvers.agent.parameters()) == 2 * (3 * 9 + 1) * 5
    before = own.measure(solvers.agent)
    levels = own.sample_target(5, Streams(0).generator())
    probes = own.probe(solvers.agent, levels)
    assert not torch.equal(probes[0], probes[1])
    solvers.update()
    after = own.measure(solvers.agent)
    assert (before["id_return"] != after["id_return"]).all()


def test_a_mixture_can_favour_the_target() -> None:
    mixture = Mixture(task().directions("target"), lambda choices, generators: choices)
    even, favoured, disfavoured = mixture.shares(
        torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    )
    wanted = [pair == (0.2, 4) for pair in task().space.specifications]
    assert sum(wanted) == 1 and even.tolist() == [0.25] * 4
    assert favoured[wanted] == pytest.approx(4 / 7) and disfavoured[wanted] == pytest.approx(1 / 13)
    assert favoured[[not here for here in wanted]].tolist() == pytest.approx([1 / 7] * 3)


def test_a_space_without_the_target_cannot_favour_it() -> None:
    elsewhere = replace(TINY, space=SpaceSettings(obstacle_fractions=[0.0], path_lengths=[2, 4]))
    with pytest.raises(ValueError, match=r"proposer\.directions=target: 0 of the space's 2 spec"):
        elsewhere.task(OPTIONS).directions("target")


@pytest.mark.parametrize("observe_agent", [False, True])
@pytest.mark.parametrize("reward", [performance_gain, task_difficulty])
def test_a_meta_step_waits_only_to_hear_the_action_and_whether_all_is_finite(
    reward, observe_agent
) -> None:
    maze = task(observe_agent)
    every_update = replace(TINY.proposer, updates_per_step=1)
    env = proposer(Parts(maze, every_update, seed=0), reward).env
    for module in env.solvers.agent.modules():
        if isinstance(module, Population):
            module.batched = True

    def on_the_host(function):
        def call(*arguments):
            with _disable_current_modes():
                return function(*arguments)

        return call

    env.proposals.levels = on_the_host(env.proposals.levels)
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


def test_levels_of_copies_are_those_of_each_alone() -> None:
    maze, choices = task(), torch.randint(TINY_CHOICES, (3, 6))
    together = maze.generate(choices, [Streams(k).generator() for k in range(3)])
    for k in range(3):
        alone = maze.generate(choices[k : k + 1], [Streams(k).generator()])
        assert (together[k] == alone[0]).all()


TINY_CHOICES = len(TINY.space.obstacle_fractions) * len(TINY.space.path_lengths)


@pytest.mark.parametrize(
    ("amx", "device", "channels", "expected"),
    [
        (True, "cpu", [64, 128, 256], "bf16"),
        (True, "cpu", [16, 32, 32], "fp32"),
        (False, "cpu", [64, 128, 256], "fp32"),
        (True, "cuda", [64, 128, 256], "fp32"),
    ],
)
def test_bf16_is_chosen_where_it_was_measured(
    monkeypatch: pytest.MonkeyPatch, amx, device, channels, expected
) -> None:
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: amx)
    assert faster_precision(channels, torch.device(device)) == expected

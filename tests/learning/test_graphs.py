"""What compiled gradient steps and graphs are made of; tests/test_gpu.py has them on a GPU."""

from __future__ import annotations

import gc
from functools import partial

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from proposer_rl.cli.build import make_task
from proposer_rl.cli.errors import exit_code
from proposer_rl.learning import PPO, graphs
from proposer_rl.models import Population
from proposer_rl.models.population import Conv3x3
from proposer_rl.streams import Streams
from tests.tasks.gymnasium.toys import GATE, TINY
from tests.tiny import composed

pytestmark = pytest.mark.filterwarnings("ignore:This module is instantiated on a machine without")


def twice(inputs: TensorDictBase) -> TensorDictBase:
    return TensorDict({"given": inputs["x"], "twice": inputs["x"].add_(inputs["x"])})


def test_neither_inputs_nor_outputs_are_shared() -> None:
    call, inputs = graphs.replayed(twice), TensorDict({"x": torch.ones(2)})
    first = call(inputs)
    second = call(inputs)
    assert inputs["x"].tolist() == [1, 1]
    assert first["twice"].tolist() == second["twice"].tolist() == [2, 2]
    first["twice"].zero_()
    assert second["twice"].tolist() == [2, 2]


def test_nothing_is_collected_while_it_is_recorded() -> None:
    seen = []

    def sees(inputs: TensorDictBase) -> TensorDictBase:
        seen.append(gc.isenabled())
        return inputs

    graphs.replayed(sees)(TensorDict())
    assert seen == [False] and gc.isenabled()


def test_what_cannot_be_recorded_is_named() -> None:
    def reads(inputs: TensorDictBase) -> TensorDictBase:
        raise RuntimeError("operation not permitted when stream is capturing")

    with pytest.raises(graphs.GraphError, match=r"graphs=True: .*reads cannot be recorded") as told:
        graphs.replayed(reads)(TensorDict())
    assert exit_code(told.value) == 2


def test_each_agent_and_each_size_has_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    made = []

    def replayed(function):
        made.append(function)
        return function

    monkeypatch.setattr(graphs, "replayed", replayed)
    one, other = torch.nn.Linear(1, 1), torch.nn.Linear(1, 1)
    call = graphs.ReplayedOfAgents(lambda agent, levels, generator: agent(levels["x"]))
    for agent in (one, other, one):
        for size in (3, 4):
            levels = TensorDict({"x": torch.rand(size, 1)}, [size])
            assert torch.equal(call(agent, levels, None), agent(levels["x"]))
    assert len(made) == 4


TASKS = {
    "maze": ["+scale=smoke"],
    "view_maze": ["task=view_maze_smoke"],
    "cartpole_memory": ["task=cartpole", *TINY, "task.network.memory=8"],
    # Minibatches, a clipped value loss, convolutions. Tracing takes as long as there are layers.
    "minigrid": ["task=minigrid", *TINY, "task.network.channels=[4]", "task.network.hidden=[8]"],
    "point_mass": ["task=point_mass", *GATE, "task.network.hidden=[8]"],
}
QUICK = ("minigrid", "point_mass")


def learner(task: str, copies: int) -> PPO:
    made = make_task(composed("+method=target", *TASKS[task], "compute.device=cpu"))
    made.batched = copies > 1  # as on a GPU; threads are nothing that a compiler sees through
    ppo = made.learner([Streams(k, "solver") for k in range(copies)])
    levels = made.target.sample(copies * made.batch_size, Streams(0).generator("levels"))
    ppo.env.set_levels(levels.reshape(copies, made.batch_size))
    return ppo


@pytest.fixture(autouse=True)
def _traced(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is compiled is traced, which tells its graphs, and runs as it is."""
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="eager"))


@pytest.mark.parametrize("copies", [1, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "task", [pytest.param(name, marks=[pytest.mark.slow] * (name not in QUICK)) for name in TASKS]
)
def test_numbers_are_the_same_but_for_rounding(
    task: str, copies: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One graph but for an LSTM through time, which stays what it is."""
    whole = "memory" not in task and "view" not in task
    monkeypatch.setattr(torch, "compile", partial(torch.compile, fullgraph=whole))
    plain, compiled = learner(task, copies), learner(task, copies).compile()
    for _ in range(2):
        one, other = (
            ppo.update([Streams(k).generator() for k in range(copies)]) for ppo in (plain, compiled)
        )
        for key, value in one.metrics.items():
            torch.testing.assert_close(other.metrics[key], value, rtol=1e-3, atol=1e-5, msg=key)


def test_convolutions_of_replicas_are_products() -> None:
    layer, maps = Conv3x3(3, 8), torch.randn(4, 3, 5, 7)
    expected = layer(maps)
    layer.as_product = True
    torch.testing.assert_close(layer(maps), expected)
    for copies, there in ((1, False), (2, True)):
        agent = learner("maze", copies).compile().agent
        (population,) = (each for each in agent.modules() if isinstance(each, Population))
        layers = [each for each in population._template[0].modules() if isinstance(each, Conv3x3)]
        assert {each.as_product for each in layers} == {there}

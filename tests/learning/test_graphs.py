"""What of replaying can be seen without a GPU; tests/test_gpu.py has the rest."""

from __future__ import annotations

import gc

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from proposer_rl.cli.errors import exit_code
from proposer_rl.learning import graphs

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

"""Recorded functions do what the functions do, with a recorder for the CPU."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from proposer_rl.learning.cuda_graphs import WARM_UPS, Captured, CudaGraphs, recorder
from tests.graphs import HostRead, NoHostReads, Tapes


class Counter:
    """A function with a state in memory, and one that only Python knows."""

    def __init__(self) -> None:
        self.total = torch.zeros(3)
        self.runs = 0

    def add(self, inputs: TensorDict, *factors: int) -> TensorDict:
        self.runs += 1
        self.total += inputs["x"]
        for factor in factors:
            self.total *= factor
        return TensorDict({"total": self.total, "last": {"x": inputs["x"] + 1}})


def inputs(value: float, size: int = 3) -> TensorDict:
    return TensorDict({"x": torch.full((size,), value)})


def test_replays_equal_calls_and_run_no_python() -> None:
    plain, counter, tapes = Counter(), Counter(), Tapes()
    captured = Captured(counter.add, tapes)
    results, expected = [], []
    for value in range(6):
        results.append(captured(inputs(value)))
        expected.append(plain.add(inputs(value)).clone())
    for result, wanted in zip(results[WARM_UPS:], expected[WARM_UPS:], strict=True):
        assert (result == wanted).all()
    assert torch.equal(counter.total, plain.total)
    assert (plain.runs, counter.runs, tapes.recorded) == (6, WARM_UPS + 1, 1)


def test_without_a_recorder_it_is_the_function() -> None:
    counter = Counter()
    captured = Captured(counter.add)
    assert [captured(inputs(1.0))["total"][0].item() for _ in range(5)] == [1, 2, 3, 4, 5]
    assert counter.runs == 5


def test_every_shape_and_every_object_has_a_recording_of_its_own() -> None:
    tapes = Tapes()
    captured = Captured(lambda td, *modules: TensorDict({"y": modules[0](td["x"])}), tapes)
    layers = [nn.Linear(3, 3), nn.Linear(3, 3)]
    x = torch.rand(5, 3)
    with torch.no_grad():
        for _ in range(WARM_UPS + 2):
            for layer in layers:
                for rows in (2, 5):
                    result = captured(TensorDict({"x": x[:rows]}), layer)["y"]
                    torch.testing.assert_close(result, layer(x[:rows]))
    assert tapes.recorded == 4


def test_expanded_inputs_are_copied_to_memory_of_their_own() -> None:
    captured = Captured(lambda td: TensorDict({"y": td["x"] * 2}), Tapes())
    for value in range(5):
        x = torch.full((1,), float(value)).expand(4)
        assert captured(TensorDict({"x": x}))["y"].tolist() == [2.0 * value] * 4


def test_training_is_recorded_with_its_gradients_and_optimiser() -> None:
    def training(tapes: Tapes | None) -> list[torch.Tensor]:
        torch.manual_seed(0)
        layer = nn.Linear(3, 1)
        adam = torch.optim.Adam(layer.parameters(), fused=True)

        def step(td: TensorDict) -> TensorDict:
            adam.zero_grad()
            loss = (layer(td["x"]) - td["y"]).square().mean()
            loss.backward()
            adam.step()
            return TensorDict({"loss": loss.detach()})

        captured = Captured(step, tapes)
        losses = [
            captured(TensorDict({"x": torch.randn(4, 3), "y": torch.randn(4, 1)}))["loss"]
            for _ in range(8)
        ]
        return [*losses, layer.weight.detach()]

    for one, other in zip(training(None), training(Tapes()), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize(
    "read",
    [
        lambda x: float(x[0]),
        lambda x: bool(x.any()),
        lambda x: x[x > 0],
        lambda x: x.nonzero(),
        lambda x: x + torch.tensor([1.0, 2.0, 3.0]),
        lambda x: torch.equal(x, x),
    ],
)
def test_what_waits_for_the_device_is_found(read) -> None:
    x = torch.ones(3)
    with NoHostReads():
        x.sum() + x[torch.arange(2)].max()
        with pytest.raises(HostRead):
            read(x)


def test_what_cannot_be_recorded_is_named() -> None:
    class Refusing(Tapes):
        def record(self, function):
            raise RuntimeError("not while capturing")

    captured = Captured(Counter().add, Refusing())
    for _ in range(WARM_UPS):
        captured(inputs(0.0))
    with pytest.raises(RuntimeError, match=r"Counter.add.*graphs=false.*not while capturing"):
        captured(inputs(0.0))


def test_graphs_are_for_cuda() -> None:
    assert recorder(torch.device("cpu")) is None
    assert isinstance(recorder(torch.device("cuda:1")), CudaGraphs)
    assert recorder(torch.device("cuda:1"), graphs=False) is None

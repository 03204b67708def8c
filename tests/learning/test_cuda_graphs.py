"""Recorded functions do what the functions do, with a recorder for the CPU."""

from __future__ import annotations

import gc
import weakref

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torch.cuda._utils import _get_device_index

from proposer_rl.learning.cuda_graphs import WARM_UPS, Captured, recorded, use
from proposer_rl.learning.ppo import PPO
from proposer_rl.models import ActorCritic, cell_logits
from proposer_rl.streams import Streams
from proposer_rl.tasks.mazes import Level, planes
from proposer_rl.tasks.mazes.evaluation import ExactEvaluator
from tests.graphs import HostRead, NoHostReads, Tapes
from tests.learning.test_ppo import learner, levels, train
from tests.tiny import tiny_view_task


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


def test_what_was_recorded_of_an_agent_ends_with_it() -> None:
    captured = Captured(lambda td, layer: TensorDict({"y": layer(td["x"])}), Tapes())
    layer = nn.Linear(3, 3)
    with torch.no_grad():
        for _ in range(WARM_UPS + 2):
            captured(TensorDict({"x": torch.rand(2, 3)}), layer)
    gone = weakref.ref(layer)
    del layer
    gc.collect()
    assert gone() is None


@pytest.mark.parametrize(("name", "current"), [("cuda:1", [1]), ("cuda", []), ("cpu", [])])
def test_a_gpu_without_a_number_is_the_current_one(
    name: str, current: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[int] = []
    # What torch.cuda.set_device does first, without a GPU.
    monkeypatch.setattr(torch.cuda, "set_device", lambda d: made.append(_get_device_index(d)))
    monkeypatch.setattr(torch, "set_float32_matmul_precision", lambda _: None)
    use(torch.device(name))
    assert made == current


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

        captured = step if tapes is None else Captured(step, tapes)
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


class Mazes:
    """The least that a task has."""

    device = torch.device("cpu")
    exact_performance = True

    def __init__(self, observe_agent: bool = False) -> None:
        self.observe_agent = observe_agent
        self.facts = {"exact": True}

    def learner(self, streams: range) -> PPO:
        return learner(len(streams), observe_agent=self.observe_agent, batched=True)

    def performance(self, agent: ActorCritic, levels: Level, generator: object) -> TensorDict:
        copies = levels.expand(agent.copies, *levels.batch_size)
        return ExactEvaluator(5)(copies, cell_logits(agent, planes(copies)))

    def probe(self, agent: ActorCritic, levels: Level) -> torch.Tensor:
        assert isinstance(levels, Level)
        return cell_logits(agent, planes(levels.expand(agent.copies, *levels.batch_size)))

    def measure(self, agent: ActorCritic) -> TensorDict:
        return TensorDict({"id_return": self.performance(agent, GIVEN[0], None)["return"].mean(1)})


GIVEN = levels(1, seed=7)


@pytest.mark.parametrize("observe_agent", [False, True])
@pytest.mark.parametrize("copies", [1, 2])
def test_replayed_updates_train_as_plain_ones(copies: int, observe_agent: bool) -> None:
    """Ten updates, of which the first are plain and the others replays: equal to the bit."""
    task, tapes = Mazes(observe_agent), Tapes()
    plain = task.learner(range(copies))
    replayed = recorded(task, tapes).learner(range(copies))
    for one, other in zip(train(plain, 10), train(replayed, 10), strict=True):
        assert (one == other).all()
    assert (plain.snapshot() == replayed.snapshot()).all()
    assert tapes.recorded == 2  # a rollout and the training on it


def test_a_solver_with_memory_is_replayed_too() -> None:
    task, tapes = tiny_view_task(), Tapes()
    streams = [Streams(0)]
    plain, replayed = task.learner(streams), recorded(task, tapes).learner(streams)
    for number in range(5):
        draw = Streams(1, number)
        levels = task.target.sample(task.batch_size, draw.generator("levels")).unsqueeze(0)
        for solver in (plain, replayed):
            solver.env.set_levels(levels)
            solver.update([draw.generator("actions")])
    assert (plain.snapshot() == replayed.snapshot()).all()
    assert tapes.recorded == 2


def test_replays_follow_a_restored_snapshot_and_leave_older_rollouts_alone() -> None:
    ppo = recorded(Mazes(), Tapes()).learner(range(1))
    *_, old = train(ppo, 4)
    kept, snapshot = old.clone(), ppo.snapshot()
    first = train(ppo, 2)
    ppo.restore(snapshot)
    assert all((a == b).all() for a, b in zip(first, train(ppo, 2), strict=True))
    assert (old == kept).all()


def test_recorded_measurements_follow_the_agents_and_the_levels() -> None:
    plain, tapes = Mazes(), Tapes()
    task = recorded(plain, tapes)
    assert isinstance(task, Mazes) and task.device == plain.device
    learners = [plain.learner(range(copies)) for copies in (1, 2)]
    with torch.no_grad():
        for update in range(5):
            for ppo in learners:
                agent, given = ppo.agent, levels(1, seed=update)[0]
                assert (task.measure(agent) == plain.measure(agent)).all()
                rated = task.performance(agent, given, torch.Generator())
                assert (rated == plain.performance(agent, given, torch.Generator())).all()
                assert torch.equal(task.probe(agent, given), plain.probe(agent, given))
                with torch.enable_grad():
                    train(ppo, 1)
    assert tapes.recorded == 3 * 2


def test_a_performance_that_draws_numbers_is_called_each_time() -> None:
    class Sampled(Mazes):
        exact_performance = False

        def performance(self, agent: ActorCritic, levels: Level, generator: object) -> TensorDict:
            drawn = torch.rand(agent.copies, len(levels), generator=generator)
            return TensorDict({"return": drawn}, drawn.shape)

    plain, tapes, drawn = Sampled(), Tapes(), []
    for task in (plain, recorded(plain, tapes)):
        agent, generator = task.learner(range(1)).agent, torch.Generator().manual_seed(0)
        drawn += [[task.performance(agent, GIVEN[0], generator)["return"] for _ in range(5)]]
    assert all(map(torch.equal, *drawn)) and not torch.equal(*drawn[1][-2:])
    assert tapes.recorded == 0


def test_without_a_gpu_nothing_is_recorded() -> None:
    task = Mazes()
    assert recorded(task) is task

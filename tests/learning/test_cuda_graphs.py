"""What tensordict's graphs replay is what plain calls give, with tapes of the CPU as graphs."""

from __future__ import annotations

import gc
import weakref

import pytest
import torch
from tensordict import TensorDict
from torch.cuda._utils import _get_device_index

from proposer_rl.learning.cuda_graphs import WARM_UPS, recorded, use
from proposer_rl.learning.ppo import PPO
from proposer_rl.models import ActorCritic, cell_logits
from proposer_rl.settings import ComputeSettings
from proposer_rl.streams import Streams
from proposer_rl.tasks.mazes import Level, planes
from proposer_rl.tasks.mazes.evaluation import ExactEvaluator
from tests.graphs import HostRead, NoHostReads, Tapes
from tests.learning.test_ppo import learner, levels, train
from tests.tiny import tiny_view_task

GPU = torch.device("cuda")
GIVEN = levels(1, seed=7)


@pytest.fixture
def tapes(monkeypatch: pytest.MonkeyPatch) -> Tapes:
    return Tapes(monkeypatch)


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


class Mazes:
    """The least that a task has; its device is what it says, its numbers are the CPU's."""

    exact_performance = True

    def __init__(self, device: torch.device = GPU, observe_agent: bool = False) -> None:
        self.device = device
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


def test_nothing_is_recorded_without_a_gpu_or_unless_it_is_asked_for() -> None:
    task = Mazes(torch.device("cpu"))
    assert recorded(task) is task
    assert not ComputeSettings().graphs


@pytest.mark.parametrize(("copies", "observe_agent"), [(1, True), (2, False)])
def test_replayed_updates_train_as_plain_ones(
    copies: int, observe_agent: bool, tapes: Tapes
) -> None:
    """Updates of which the first are plain and the others replays, equal to the bit."""
    task = Mazes(observe_agent=observe_agent)
    plain, replayed = (t.learner(range(copies)) for t in (task, recorded(task)))
    updates = WARM_UPS + 1
    # Each rollout is compared after later ones: replays leave it alone.
    for one, other in zip(train(plain, updates), train(replayed, updates), strict=True):
        assert (one == other).all()
    snapshot = plain.snapshot()
    assert (snapshot == replayed.snapshot()).all()
    assert tapes.recorded == 2  # a rollout and the training on it
    first = train(replayed, 1)
    replayed.restore(snapshot)
    assert (first[0] == train(replayed, 1)[0]).all()


def test_a_solver_with_memory_is_replayed_too(tapes: Tapes) -> None:
    task, on_gpu = tiny_view_task(), Mazes()
    on_gpu.learner = task.learner  # type: ignore[method-assign]
    plain, replayed = (t.learner([Streams(0)]) for t in (task, recorded(on_gpu)))
    for number in range(WARM_UPS + 1):
        draw = Streams(1, number)
        levels = task.target.sample(task.batch_size, draw.generator("levels")).unsqueeze(0)
        for solver in (plain, replayed):
            solver.env.set_levels(levels)
            solver.update([draw.generator("actions")])
    assert (plain.snapshot() == replayed.snapshot()).all()
    assert tapes.recorded == 2


@torch.no_grad()
def test_recorded_measurements_follow_the_agents_and_levels_and_end_with_an_agent(
    tapes: Tapes,
) -> None:
    plain = Mazes()
    task = recorded(plain)
    assert isinstance(task, Mazes) and task.device == plain.device
    learners = [plain.learner(range(copies)) for copies in (1, 2)]
    for update in range(WARM_UPS + 1):
        for ppo in learners:
            agent, given = ppo.agent, levels(1, seed=update)[0]
            assert (task.measure(agent) == plain.measure(agent)).all()
            rated = task.performance(agent, given, torch.Generator())
            assert (rated == plain.performance(agent, given, torch.Generator())).all()
            for probes in (given, given[:2]):
                assert torch.equal(task.probe(agent, probes), plain.probe(agent, probes))
            with torch.enable_grad():
                train(ppo, 1)
    assert tapes.recorded == 4 * 2
    gone = weakref.ref(learners[0].agent)
    del learners, ppo, agent
    gc.collect()
    assert gone() is None


def test_a_performance_that_draws_numbers_is_called_each_time(tapes: Tapes) -> None:
    class Sampled(Mazes):
        exact_performance = False

        def performance(self, agent: ActorCritic, levels: Level, generator: object) -> TensorDict:
            drawn = torch.rand(agent.copies, len(levels), generator=generator)
            return TensorDict({"return": drawn}, drawn.shape)

    plain, drawn = Sampled(), []
    for task in (plain, recorded(plain)):
        agent, generator = task.learner(range(1)).agent, torch.Generator().manual_seed(0)
        drawn += [[task.performance(agent, GIVEN[0], generator)["return"] for _ in range(5)]]
    assert all(map(torch.equal, *drawn)) and not torch.equal(*drawn[1][-2:])
    assert tapes.recorded == 0

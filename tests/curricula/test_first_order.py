"""First-order gain in closed form, and Proposers that are rewarded for each problem."""

from __future__ import annotations

import copy
import json
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from proposer_rl import curricula as c
from proposer_rl import methods, models
from proposer_rl.curricula import Filtered, FirstOrderProposer
from proposer_rl.learning import PPO, DivergedError, PPOSettings, SolverSettings
from proposer_rl.meta.assembly import ProposerSettings
from proposer_rl.methods import Components
from proposer_rl.settings import ArgumentError
from proposer_rl.streams import Streams
from proposer_rl.task import Task
from proposer_rl.tasks.mazes import Level, SpecificationSpace
from proposer_rl.tasks.mazes.generation import LevelDistribution
from tests.curricula.living import TASK, live, solvers, student
from tests.curricula.made import filtered, paired
from tests.curricula.scripted import GivenScores
from tests.meta import test_first_order as exact
from tests.tasks.gymnasium.toys import walk_task
from tests.tiny import evaluate

BINS, P = 6, 16


class Skills:
    """A Solver that is numbers: the return of bin n is skill n, of the target a sum of some."""

    copies = 1

    def __init__(self, wanted: list[float]) -> None:
        self.wanted = torch.tensor(wanted)
        module = nn.Module()
        module.skills = nn.Parameter(torch.zeros(1, len(wanted)))
        self.agent = module
        self.settings = SimpleNamespace(learning_rate=0.01, adam_eps=0.0, gamma=1.0, lmbda=1.0)
        self.env = SimpleNamespace(batch_size=torch.Size([1, P]))
        self.device, self.batch_size, self.distributions = torch.device("cpu"), P, {}
        self.target = SimpleNamespace(sample=lambda count, generator: torch.full((count,), -1))
        self.space = SimpleNamespace(
            size=len(wanted),
            axes={"row": [0.0, 1.0], "column": [0.0, 1.0, 2.0]},
            generate=lambda choices, generators: choices,
        )

    def snapshot(self) -> TensorDict:
        """Adam's state before its first step."""
        skills = self.agent.skills.detach()
        zero = torch.zeros(len(skills))
        return TensorDict({"skills": {"exp_avg_sq": 0 * skills, "step": zero}}, [len(skills)])

    def differentiable_performance(self, agent: nn.Module, levels: Tensor) -> TensorDict:
        of_bins = agent.skills.gather(1, levels.clamp(min=0))
        target = (agent.skills @ self.wanted).unsqueeze(1)
        return TensorDict({"return": torch.where(levels < 0, target, of_bins)}, levels.shape)

    def probe(self, agent: nn.Module, levels: Tensor) -> Tensor:
        return torch.ones(len(self.agent.skills), len(levels), 3)


def taught(task: Any, learner: Any = None) -> c.TaskStudent:
    return c.TaskStudent(task, learner or task)


def test_shares_follow_the_known_alignments() -> None:
    wanted = [2.0, 1.0, 0.0, -1.0, 0.0, 0.5]
    task = Skills(wanted)
    curriculum = c.FirstOrderCurriculum(task.space, task.target, measure="return", temperature=0.5)
    levels = curriculum.propose(taught(task), P, Streams(0)).levels
    # The direction is that of the wanted skills, and the alignment of bin n its n-th number.
    expected = (torch.tensor(wanted) / (0.5 * 2.0)).softmax(-1)
    torch.testing.assert_close(curriculum.shares(), expected, rtol=1e-4, atol=1e-6)
    assert ((levels.bincount(minlength=BINS) - P * expected).abs() < 1).all()


def test_scores_are_averaged_over_time() -> None:
    task = Skills([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    curriculum = c.FirstOrderCurriculum(
        task.space, task.target, measure="return", every=1, smoothing=0.75
    )
    curriculum.propose(taught(task), P, Streams(0))
    first = curriculum.state_dict()["scores"]["score"]
    task.wanted = torch.tensor([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    curriculum.propose(taught(task), P, Streams(0))
    second = curriculum.state_dict()["scores"]["score"]
    torch.testing.assert_close(second[:2] / first[0], torch.tensor([0.75, 0.25]))


def test_bins_without_any_score_are_drawn_uniformly() -> None:
    task = Skills([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    curriculum = c.FirstOrderCurriculum(task.space, task.target, measure="return")
    curriculum.scores = {"score": torch.zeros(BINS), "variance": torch.zeros(BINS)}
    torch.testing.assert_close(curriculum.shares(), torch.full((BINS,), 1 / BINS))


class Axes(SpecificationSpace):
    axes = {"obstacle fraction": [0.0, 0.2, 0.3], "path length": [2.0, 4.0]}  # noqa: RUF012


class Mazes(Skills):
    """Small mazes with the exact evaluation of what plays them."""

    spectators = Task.spectators

    def __init__(self) -> None:
        self.device, self.batch_size, self.distributions = torch.device("cpu"), P, {}
        self.target = LevelDistribution([(0.3, 4)], "uniform", 4, 4)
        self.space = Axes((0.0, 0.2, 0.3), (2, 4), "uniform", 4, 4)

    def differentiable_performance(self, agent: nn.Module, levels: Level) -> TensorDict:
        return exact.performance(agent, levels)

    def performance(self, agent: nn.Module, levels: Level, generator: Any) -> TensorDict:
        return exact.performance(agent, levels)


def mazes(**options: Any) -> c.FirstOrderCurriculum:
    task = Mazes()
    return c.FirstOrderCurriculum(
        task.space, task.target, **{"target_levels": 8, "candidates": 3, **options}
    )


def learner() -> PPO:
    return exact.learner(exact.some_levels(1, P), 1)


def test_scores_are_mean_inner_products_with_the_target_direction() -> None:
    task, solver, curriculum = Mazes(), learner(), mazes(step=0.3)  # nearly a derivative
    curriculum.propose(taught(Mazes(), solver), P, Streams(0))
    found = curriculum.state_dict()["scores"]
    target = task.target.sample(8, Streams(0).generator("target"))[None]
    direction = exact.exact_direction(solver, target)
    bins = torch.arange(BINS).repeat_interleave(3)[None]
    levels = task.space.generate(bins, [Streams(0).generator("candidates")])
    values = (exact.performance(solver.agent, levels)["return"][:, i] for i in range(3 * BINS))
    aligned = [exact.inner(direction, exact.gradient(solver.agent, one.sum())) for one in values]
    each = torch.stack(aligned, 1).unflatten(1, (BINS, 3))[0]
    torch.testing.assert_close(found["score"], each.mean(-1), rtol=1e-4, atol=1e-7)
    torch.testing.assert_close(found["variance"], each.var(-1) / 3, rtol=1e-3, atol=1e-10)
    far = mazes(step=1000.0)  # differences, and no derivatives any more
    far.propose(taught(Mazes(), solver), P, Streams(0))
    assert not torch.allclose(far.state_dict()["scores"]["score"], each.mean(-1), rtol=0.05)


def test_the_log_has_standard_errors_and_how_even_the_shares_are() -> None:
    curriculum, solver = mazes(), learner()
    curriculum.propose(taught(Mazes(), solver), P, Streams(0))
    told = json.loads(json.dumps(curriculum.log()))
    assert torch.tensor(told["score"]).shape == torch.tensor(told["score_error"]).shape == (3, 2)
    entropy = torch.distributions.Categorical(curriculum.shares()).entropy()
    assert told["share_entropy"] == pytest.approx(float(entropy))
    assert 1 <= told["effective_bins"] <= BINS


WANTED = [0.0, 0.0, 1.0, 0.0, 0.5, 0.0]


def agent() -> models.ActorCritic:
    torch.manual_seed(0)
    head = models.ProblemHead(8, P, BINS, hidden=16, bands=4)
    network = models.ProposerNetwork(head, nn.Linear(3, 8), context=8, hidden=8)
    return models.proposer_actor_critic(network, models.categorical)


def proposer(task: Skills, **settings: Any) -> FirstOrderProposer:
    numbers = {"learning_rate": 1e-2, "epochs": 4, "entropy_coeff": 0.02, **settings}
    return rewarded(task.space, task.target, agent(), PPOSettings(**numbers))


rewarded = partial(FirstOrderProposer, probe_levels=2, target_levels=3, step=1.0, measure="return")


@pytest.mark.parametrize("times", [1, 3])
def test_every_problem_is_credited_with_its_own_alignment(times: int) -> None:
    """Also those on which the Solver does not train, which are those with the lowest scores.

    The gradient of Adam's first step is of draws that are rewarded as their bins are wanted, up to
    a factor, which standardising takes out.
    """
    task = Skills(WANTED)
    curriculum = proposer(task, epochs=1, entropy_coeff=0.3, max_grad_norm=100.0)
    expected, student = copy.deepcopy(curriculum.agent), taught(task)
    scores = GivenScores(torch.arange(float(times * P)))
    filtered = Filtered(curriculum, scores, times=max(times, 2), temperature=1e-3)
    batch = (curriculum if times == 1 else filtered).propose(student, P, Streams(0))
    assert student.evaluations == 3 + 2 * P * times
    seen = TensorDict({"probes": torch.ones(1, 2, 3)}, [1])
    policy = torch.distributions.Categorical(logits=expected(seen)["logits"][0])
    noise = torch.rand(times, 1, P, generator=Streams(0).generator("choices"))
    choices = models.draw_at(policy, noise)  # [times, 1, P]
    reward = torch.tensor(WANTED)[choices]
    advantage = (reward - reward.mean()) / reward.std()
    adam = torch.optim.Adam(expected.parameters(), lr=1e-2, eps=1e-5)
    (-(advantage * policy.log_prob(choices)).mean() - 0.3 * policy.entropy().mean()).backward()
    adam.step()
    assert sorted(batch.levels.tolist()) == sorted(choices[-1, 0].tolist())
    for one, other in zip(curriculum.agent.parameters(), expected.parameters(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("paid", "told"),
    [(torch.inf, "copy 0: reward is"), (1e38, "loss_objective of gradient step 0")],
)
def test_numbers_that_went_wrong_are_told_where_they_arise(
    paid: float, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = Skills(WANTED)
    curriculum = proposer(task)
    monkeypatch.setattr(curriculum, "reward", lambda *_: (torch.full((P,), paid), {}))
    with pytest.raises(DivergedError, match=f"^the Proposer: {told}"):
        curriculum.propose(taught(task), P, Streams(0, 0))


def test_it_learns_to_choose_what_the_target_needs() -> None:
    task = Skills(WANTED)
    curriculum = proposer(task)
    for update in range(60):
        student = taught(task)
        batch = curriculum.propose(student, P, Streams(0, update))
    assert batch.levels.shape == (P,)
    assert (student.frames, student.evaluations) == (0, 3 + 2 * P)
    assert (batch.levels == 2).float().mean() > 0.8


def test_all_that_it_computes_with_is_on_the_tasks_device() -> None:
    """The bounds of TorchRL's clipping, and Adam's moments after a checkpoint, read to the CPU."""
    begun, task = proposer(Skills(WANTED)), Skills(WANTED)
    begun.propose(taught(task), P, Streams(0))
    there = SimpleNamespace(sample=lambda count, generator: torch.full((count,), -1, device="meta"))
    elsewhere = rewarded(task.space, there, agent().to("meta"), PPOSettings())
    elsewhere.load_state_dict(begun.state_dict())
    assert all(bound.is_meta for bound in elsewhere._loss.buffers())
    moments = [
        entry
        for state in elsewhere._adam.state.values()
        for key, entry in state.items()
        if key != "step"  # which Adam counts on the CPU
    ]
    assert moments and all(moment.is_meta for moment in moments)


def test_a_proposer_that_has_not_begun_resumes_too() -> None:
    task = Skills(WANTED)
    one, other = proposer(task), proposer(task)
    other.load_state_dict(one.state_dict())
    assert one.log() == {}
    levels = [c.propose(taught(task), P, Streams(0)).levels for c in (one, other)]
    assert torch.equal(*levels)


MAZES = TASK.batch_size


def test_equal_students_have_no_regret() -> None:
    curriculum = paired(Streams(0, "solver"))  # the protagonist's own
    levels = TASK.space.sample(MAZES, torch.Generator().manual_seed(0))
    regret, metrics = curriculum.reward(student(0), levels, Streams(0))
    assert (regret == 0).all() and metrics["regret"] == 0


@pytest.mark.parametrize("times", [1, 2])
def test_the_reward_is_what_the_antagonist_gets_more(times: int) -> None:
    curriculum, learner = paired(), solvers([0])
    antagonist = TASK.learner([Streams(0, "antagonist")]).agent
    levels = TASK.space.sample(MAZES, torch.Generator().manual_seed(2))
    regret, _ = curriculum.reward(student(0), levels, Streams(0))
    other, own = (evaluate(agent, levels)["return"][0] for agent in (antagonist, learner.agent))
    torch.testing.assert_close(regret, (other - own).clamp_min(0))
    assert float(regret.max()) > 0
    whole = curriculum if times == 1 else filtered(curriculum, times=times)
    (lived,) = live([whole], learner, [0], range(4))
    # Both students on all that is drawn; the antagonist trains on what the protagonist trained on.
    assert lived.frames == [MAZES * 8] * 4
    assert lived.evaluations == [2 * times * MAZES + (times > 1) * times * MAZES] * 4
    assert int(torch.tensor(lived.told[-1]["histogram"]).sum()) == 3 * MAZES


def test_the_antagonist_trains_on_the_same_levels_with_its_own_chance() -> None:
    curriculum, learner = paired(), solvers([0])
    plain = TASK.learner([Streams(0, "antagonist")])
    (lived,) = live([curriculum], learner, [0], range(2))
    for number, levels in enumerate(lived.levels):
        plain.env.set_levels(levels.unsqueeze(0))
        plain.update([Streams(0, "update", number).generator("antagonist")])
    assert (plain.snapshot()[0] == curriculum.antagonist.snapshot()).all()


def test_it_has_no_second_solver_whose_episodes_go_on() -> None:
    ppo = PPOSettings(horizon=8, continue_episodes=True)
    task = walk_task(solver=SolverSettings(batch_size=MAZES, ppo=ppo))
    components = Components(task, ProposerSettings(), 0)
    with pytest.raises(ArgumentError, match=r"^continue_episodes=True: the second Solver"):
        methods.paired(components)

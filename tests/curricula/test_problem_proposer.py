"""Proposers that are rewarded for each problem: by first-order gain, and PAIRED's regret."""

from __future__ import annotations

import copy
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from proposer_rl import methods, models
from proposer_rl.curricula import (
    Curriculum,
    Filtered,
    FirstOrderProposer,
)
from proposer_rl.learning import DivergedError, PPOSettings, SolverSettings
from proposer_rl.meta.assembly import ProposerSettings
from proposer_rl.methods import Components
from proposer_rl.models.actor_critic import ActorCritic
from proposer_rl.settings import ArgumentError
from proposer_rl.streams import Streams
from tests.curricula.living import TASK, live, solvers, student
from tests.curricula.made import filtered, paired
from tests.curricula.scripted import GivenScores
from tests.curricula.test_first_order import BINS, P, Skills, taught
from tests.tasks.gymnasium.toys import walk_task
from tests.tiny import evaluate

WANTED = [0.0, 0.0, 1.0, 0.0, 0.5, 0.0]


class Seen(Skills):
    """Skills that a Proposer looks at."""

    def probe(self, agent: nn.Module, levels: Tensor) -> Tensor:  # type: ignore[override]
        return torch.ones(len(self.agent.skills), len(levels), 3)


def agent() -> ActorCritic:
    torch.manual_seed(0)
    head = models.ProblemHead(8, P, BINS, hidden=16, bands=4)
    network = models.ProposerNetwork(head, nn.Linear(3, 8), context=8, hidden=8)
    return models.proposer_actor_critic(network, models.categorical)


def ppo(**settings: Any) -> PPOSettings:
    return PPOSettings(**{"learning_rate": 1e-2, "epochs": 4, "entropy_coeff": 0.02, **settings})


def proposer(task: Seen, **settings: Any) -> FirstOrderProposer:
    return rewarded(task.space, task.target, agent(), ppo(**settings))


def rewarded(*parts: Any) -> FirstOrderProposer:
    return FirstOrderProposer(*parts, probe_levels=2, target_levels=3, step=1.0, measure="return")


def the_last_of(curriculum: Curriculum, times: int) -> Curriculum:
    """Trains on one in so many levels: those with the highest scores, which are the last."""
    scores = GivenScores(torch.arange(float(times * P)))
    return curriculum if times == 1 else Filtered(curriculum, scores, times=times, temperature=1e-3)


def step_by_hand(expected: ActorCritic, streams: Streams, times: int, kept: slice) -> Tensor:
    """Makes Adam's first step, on the objective of draws that are paid as their bins are wanted.

    Returns:
        The last P draws.
    """
    seen = TensorDict({"probes": torch.ones(1, 2, 3)}, [1])
    policy = torch.distributions.Categorical(logits=expected(seen)["logits"][0])
    noise = torch.rand(times, 1, P, generator=streams.generator("choices"))
    choices = models.draw_at(policy, noise)[kept]  # [times, 1, P]
    paid = torch.tensor(WANTED)[choices]  # up to a factor, which standardising takes out
    advantage = (paid - paid.mean()) / paid.std()
    loss = -(advantage * policy.log_prob(choices)).mean() - 0.3 * policy.entropy().mean()
    adam = torch.optim.Adam(expected.parameters(), lr=1e-2, eps=1e-5)
    loss.backward()
    adam.step()
    return choices[-1, 0]


def assert_same_weights(found: ActorCritic, expected: ActorCritic) -> None:
    for one, other in zip(found.parameters(), expected.parameters(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("paid", "told"),
    [(torch.inf, "copy 0: reward is"), (1e38, "loss_objective of gradient step 0")],
)
def test_numbers_that_went_wrong_are_told_where_they_arise(
    paid: float, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = Seen(WANTED)
    curriculum = proposer(task)
    monkeypatch.setattr(curriculum, "reward", lambda *_: (torch.full((P,), paid), {}))
    with pytest.raises(DivergedError, match=f"^the Proposer: {told}"):
        curriculum.propose(taught(task), P, Streams(0, 0))


def test_it_learns_to_choose_what_the_target_needs() -> None:
    task = Seen(WANTED)
    curriculum = proposer(task)
    for update in range(60):
        student = taught(task)
        batch = curriculum.propose(student, P, Streams(0, update))
    assert batch.levels.shape == (P,)
    assert (student.frames, student.evaluations) == (0, 3 + 2 * P)
    assert (batch.levels == 2).float().mean() > 0.8


@pytest.mark.parametrize("times", [1, 3])
def test_every_problem_is_credited_with_its_own_alignment(times: int) -> None:
    """Also those that the Solver does not train on."""
    task = Seen(WANTED)
    curriculum = proposer(task, epochs=1, entropy_coeff=0.3, max_grad_norm=100.0)
    expected, student = copy.deepcopy(curriculum.agent), taught(task)
    batch = the_last_of(curriculum, times).propose(student, P, Streams(0))
    assert student.evaluations == 3 + 2 * P * times
    last = step_by_hand(expected, Streams(0), times, slice(None))
    assert sorted(batch.levels.tolist()) == sorted(last.tolist())
    assert_same_weights(curriculum.agent, expected)


def test_all_that_it_computes_with_is_on_the_tasks_device() -> None:
    """The bounds of TorchRL's clipping, and Adam's moments after a checkpoint, read to the CPU."""
    begun, task = proposer(Seen(WANTED)), Seen(WANTED)
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
    task = Seen(WANTED)
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

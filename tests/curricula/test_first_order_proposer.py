"""The Proposer that is paid for each problem, on Solvers whose best batch is known."""

from __future__ import annotations

import copy
import json
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from proposer_rl.curricula import Choice
from proposer_rl.curricula.first_order_proposer import FirstOrderProposer
from proposer_rl.curricula.problem_proposer import Worth
from proposer_rl.learning import DivergedError
from proposer_rl.learning.ppo import PPOSettings
from proposer_rl.models import (
    ProblemHead,
    ProposerNetwork,
    categorical,
    draw,
    proposer_actor_critic,
)
from proposer_rl.models.actor_critic import ActorCritic
from proposer_rl.streams import Streams
from tests.curricula.living import check_it_resumes, solvers
from tests.curricula.scripted import GivenScores
from tests.curricula.test_first_order import BINS, P, Skills
from tests.tiny import TASK as MAZES

WANTED = [0.0, 0.0, 1.0, 0.0, 0.5, 0.0]


class Seen(Skills):
    """Skills that a Proposer looks at."""

    def probe(self, agent: nn.Module, levels: Tensor) -> Tensor:  # type: ignore[override]
        return torch.ones(len(self.agent.skills), len(levels), 3)


def agent() -> ActorCritic:
    torch.manual_seed(0)
    head = ProblemHead(8, P, BINS, hidden=16, bands=4)
    network = ProposerNetwork(head, nn.Linear(3, 8), context=8, hidden=8)
    return proposer_actor_critic(network, categorical)


def proposer(task: Seen, choice: Choice | None = None, **settings: Any) -> FirstOrderProposer:
    chosen = {"learning_rate": 1e-2, "epochs": 4, "entropy_coeff": 0.02, **settings}
    return FirstOrderProposer(
        task,
        agent(),
        PPOSettings(**chosen),
        probe_levels=2,
        choice=choice,
        target_levels=3,
        measure="return",
    )


@pytest.mark.parametrize(
    ("paid", "told"),
    [(torch.inf, "copy 0: reward is"), (1e38, "loss_objective of gradient step 0")],
)
def test_numbers_that_went_wrong_are_told_where_they_arise(
    paid: float, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = Seen(1, WANTED)
    curriculum = proposer(task)
    monkeypatch.setattr(curriculum, "worth", lambda *_: Worth(torch.full((1, P), paid), {}))
    with pytest.raises(DivergedError, match=f"^the Proposer: {told}"):
        curriculum.propose(task, 0, [Streams(0, 0)])


def test_it_learns_to_choose_what_the_target_needs() -> None:
    task = Seen(1, WANTED)
    curriculum = proposer(task)
    for update in range(60):
        proposal = curriculum.propose(task, update, [Streams(0, update)])
    assert proposal.levels.shape == (1, P)
    assert (proposal.frames, proposal.evaluations) == (0, 3 + 2 * P)
    assert (proposal.levels == 2).float().mean() > 0.8


@pytest.mark.parametrize(("times", "solvers"), [(1, 1), (3, 1), (3, 2)])
def test_every_problem_is_credited_with_its_own_alignment(times: int, solvers: int) -> None:
    """Also those that the Solver does not train on, and those of its copies."""
    task = Seen(solvers, WANTED)
    settings = {"epochs": 1, "entropy_coeff": 0.3, "max_grad_norm": 100.0}
    scores = torch.arange(float(times * P)).expand(solvers, -1)
    pick = Choice(GivenScores(scores), times=times, temperature=1e-3) if times > 1 else None
    curriculum = proposer(task, pick, **settings)
    expected = copy.deepcopy(curriculum.agent)
    streams = [Streams(seed) for seed in range(solvers)]
    _, proposal = curriculum.draw_and_learn(task, streams)
    assert proposal.evaluations == 3 + 2 * P * times + (P * times if pick else 0)

    seen = TensorDict({"probes": torch.ones(1, 2, 3)}, [1])
    policy = torch.distributions.Categorical(logits=expected(seen)["logits"][0])
    noise = [torch.rand(times, P, generator=s.generator("choices")) for s in streams]
    choices = draw(policy, torch.stack(noise))  # [K, times, P]
    # Of the scores above those of the last are the highest.
    for chosen, drawn in zip(proposal.levels, choices, strict=True):
        assert sorted(chosen.tolist()) == sorted(drawn[-1].tolist())
    paid = torch.tensor(WANTED)[choices]  # up to a factor, which standardising takes out
    advantage = (paid - paid.mean()) / paid.std()
    loss = -(advantage * policy.log_prob(choices)).mean() - 0.3 * policy.entropy().mean()
    by_hand = torch.optim.Adam(expected.parameters(), lr=1e-2, eps=1e-5)
    loss.backward()
    by_hand.step()
    for found, wanted in zip(curriculum.agent.parameters(), expected.parameters(), strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-5)


def on_mazes(copies: int, **numbers: Any) -> FirstOrderProposer:
    torch.manual_seed(0)
    head = ProblemHead(8, MAZES.batch_size, MAZES.space.size, hidden=16, bands=4)
    network = ProposerNetwork(head, MAZES.probe_encoder(8), context=8, hidden=8)
    return FirstOrderProposer(
        MAZES,
        proposer_actor_critic(network, categorical),
        PPOSettings(learning_rate=1e-2),
        probe_levels=2,
        target_levels=3,
        copies=copies,
        copy_updates=3,
        **numbers,
    )


def test_it_learns_from_copies_and_leaves_the_solver_as_it_is() -> None:
    done: list[int] = []
    curriculum, learner = on_mazes(2, on_update=done.append), solvers([0])
    before, weights = learner.snapshot().clone(), copy.deepcopy(curriculum.agent.state_dict())
    batches = []
    trained = curriculum._copies.env.set_levels
    curriculum._copies.env.set_levels = lambda levels: (batches.append(levels), trained(levels))
    outcome = curriculum.improve(learner, 0, [Streams(0)])
    size, horizon = MAZES.batch_size, learner.settings.horizon
    assert outcome.frames == 2 * 3 * size * horizon
    assert outcome.evaluations == 2 * 3 * (3 + 2 * size)
    assert done == [1, 2, 3] and len(batches) == 3
    assert not (batches[0][0] == batches[0][1]).all()
    assert (learner.snapshot() == before).all()
    after = curriculum._copies.snapshot()
    moved = [(entry[0] != entry[1]).any() for entry in after.flatten_keys().values()]
    assert any(moved)
    assert any(not torch.equal(w, weights[n]) for n, w in curriculum.agent.state_dict().items())

    curriculum.propose(learner, 0, [Streams(0, "update")])
    told = curriculum.improve(learner, 1, [Streams(1)]).metrics
    assert int(torch.tensor(told["histogram"]).sum()) == size  # of the Solver's own batch alone


def test_with_copies_it_resumes_bit_by_bit() -> None:
    check_it_resumes(lambda: on_mazes(2))


@pytest.mark.parametrize("copies", [-1, 1.5, True])
def test_copies_that_make_no_sense_are_refused(copies: Any) -> None:
    with pytest.raises(ValueError, match="copies must be a whole number from 0"):
        on_mazes(copies)


def test_a_resumed_proposer_goes_on_bit_by_bit() -> None:
    def run(curriculum: FirstOrderProposer, updates: range) -> list[Tensor]:
        return [curriculum.propose(task, u, [Streams(0, u)]).levels for u in updates]

    task = Seen(1, WANTED)
    straight, interrupted, resumed = (proposer(task) for _ in range(3))
    expected = run(straight, range(6))[3:]
    run(interrupted, range(3))
    resumed.load_state_dict(interrupted.state_dict())
    found = run(resumed, range(3, 6))
    assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))
    told = [c.improve(task, 6, [Streams(0)]).metrics for c in (straight, resumed)]
    assert json.dumps(told[0]) == json.dumps(told[1])
    assert int(torch.tensor(told[0]["histogram"]).sum()) == 6 * P
    one, other = straight.agent.state_dict(), resumed.agent.state_dict()
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_all_that_it_computes_with_is_on_the_tasks_device() -> None:
    """The bounds of TorchRL's clipping, and Adam's moments after a checkpoint, read to the CPU."""
    begun, task = proposer(Seen(1, WANTED)), Seen(1, WANTED)
    begun.propose(task, 0, [Streams(0)])
    task.device = torch.device("meta")
    elsewhere = FirstOrderProposer(task, agent().to("meta"), PPOSettings())
    elsewhere.load_state_dict(begun.state_dict())
    assert all(bound.is_meta for bound in elsewhere._loss.buffers())
    moments = [
        entry
        for state in elsewhere._adam.state.values()
        for key, entry in state.items()
        if key != "step"  # which Adam counts on the CPU
    ]
    assert moments and all(moment.is_meta for moment in moments)


def test_a_new_life_tells_nothing_of_the_last_one() -> None:
    task = Seen(1, WANTED)
    curriculum = proposer(task)
    curriculum.propose(task, 0, [Streams(0)])
    learnt = copy.deepcopy(curriculum.agent.state_dict())
    curriculum.begin()
    assert curriculum.improve(task, 0, [Streams(0)]).metrics == {}
    after = curriculum.agent.state_dict()
    assert all(torch.equal(after[name], learnt[name]) for name in learnt)


def test_a_proposer_that_has_not_begun_resumes_too() -> None:
    task = Seen(1, WANTED)
    one, other = proposer(task), proposer(task)
    other.load_state_dict(one.state_dict())
    assert one.improve(task, 0, [Streams(0)]).metrics == {}
    levels = [c.propose(task, 0, [Streams(0)]).levels for c in (one, other)]
    assert torch.equal(*levels)


def test_several_solvers_are_refused() -> None:
    task = Seen(2, WANTED)
    with pytest.raises(ValueError, match="a Proposer learns from one Solver, got 2"):
        proposer(task).propose(task, 0, [Streams(0), Streams(1)])


@pytest.mark.parametrize("wrong", [{"epochs": 0}, {"learning_rate": 0.0}, {"entropy_coeff": -0.1}])
def test_numbers_that_make_no_sense_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(wrong))} must be"):
        proposer(Seen(1, WANTED), **wrong)


def test_a_task_without_gradients_is_refused() -> None:
    with pytest.raises(TypeError, match="must define differentiable_performance"):
        FirstOrderProposer(SimpleNamespace(), agent(), PPOSettings())

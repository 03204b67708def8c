"""PAIRED: what is paid is the regret between two students, and both train."""

from __future__ import annotations

import pytest
import torch

from proposer_rl.curricula import Choice, PairedProposer
from proposer_rl.models import (
    ActorCritic,
    ProblemHead,
    ProposerNetwork,
    categorical,
    proposer_actor_critic,
)
from proposer_rl.settings import PPOSettings
from proposer_rl.streams import Streams
from tests.curricula.living import check_it_resumes, live, solvers
from tests.tiny import TASK, evaluate

P, T = 4, 8


def agent() -> ActorCritic:
    torch.manual_seed(0)
    head = ProblemHead(8, P, TASK.space.size, hidden=16, bands=4)
    network = ProposerNetwork(head, TASK.probe_encoder(8), context=8, hidden=8)
    return proposer_actor_critic(network, categorical)


def paired(streams: Streams | None = None, choice: Choice | None = None) -> PairedProposer:
    settings = PPOSettings(horizon=1, learning_rate=3e-3, epochs=2)
    streams = streams or Streams(0, "antagonist")
    return PairedProposer(TASK, agent(), settings, streams=streams, probe_levels=2, choice=choice)


def test_it_lives_as_a_curriculum_should() -> None:
    check_it_resumes(paired)


def test_the_antagonist_begins_anew_with_a_new_solver() -> None:
    used = paired()
    born = used.antagonist.snapshot()
    live(used, solvers([0]), [0], range(2))
    assert not (used.antagonist.snapshot() == born).all()
    used.begin()
    assert (used.antagonist.snapshot() == born).all()


def test_equal_students_have_no_regret() -> None:
    curriculum = paired(Streams(0, "solver"))  # the protagonist's own
    levels = TASK.space.sample(P, torch.Generator().manual_seed(0)).unsqueeze(0)
    worth = curriculum.worth(solvers([0]), levels, [Streams(0)])
    assert (worth.paid == 0).all() and worth.told["regret"] == 0


def test_what_is_paid_is_what_the_antagonist_gets_more() -> None:
    curriculum, learner = paired(), solvers([0])
    lived = live(curriculum, learner, [0], range(2))
    assert lived.frames == [P * T] * 2 and lived.evaluations == [2 * P] * 2
    levels = TASK.space.sample(P, torch.Generator().manual_seed(1))
    found = curriculum.worth(learner, levels.unsqueeze(0), [Streams(0)]).paid[0]
    other, own = (
        evaluate(agent, levels)["return"][0]
        for agent in (curriculum.antagonist.agent, learner.agent)
    )
    torch.testing.assert_close(found, (other - own).clamp_min(0))
    assert float(found.max()) > 0


def test_the_antagonist_trains_on_the_same_levels_with_its_own_chance() -> None:
    curriculum, learner = paired(), solvers([0])
    plain = TASK.learner([Streams(0, "antagonist")])
    lived = live(curriculum, learner, [0], range(2))
    for number, levels in enumerate(lived.levels):
        plain.env.set_levels(levels)
        plain.update([Streams(0, "update", number).generator("antagonist")])
    assert (plain.snapshot() == curriculum.antagonist.snapshot()).all()


def test_it_learns_from_one_solver() -> None:
    with pytest.raises(ValueError, match="learns from one Solver, got 2"):
        live(paired(), solvers([0, 1]), [0, 1], range(1))

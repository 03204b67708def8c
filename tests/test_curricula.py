from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn

from proposer_rl import curricula as c
from proposer_rl import models
from proposer_rl.learning import PPO, LeaveOneOutBaseline, PPOSettings, agent_weights, load_agent
from proposer_rl.meta.rewards import log_success_gain
from proposer_rl.streams import Streams
from tests.meta.test_env import SPACE, TASK, E, K, L, P, learners, meta_env, mixture

HELD = {"mix": True, "meta_episode_length": 4, "action_repeat": 2}


cycle, update = partial(Streams, 0, "cycle"), partial(Streams, 0, "update")


def student() -> c.TaskStudent:
    return c.TaskStudent(TASK, learners(1))


def proposer_agent(mix: bool) -> models.ActorCritic:
    torch.manual_seed(0)
    head: nn.Module = models.ProblemHead(8, P, SPACE.size, hidden=8)
    if mix:
        head = models.MixtureHead(8, SPACE.size, hidden=8)
    network = models.ProposerNetwork(head, TASK.probe_encoder(8), context=8, hidden=8)
    return models.proposer_actor_critic(network, models.normal if mix else models.categorical)


def proposer(*, own_action: str = "sample", mix: bool = False, **options) -> c.ProposerCurriculum:
    """A Proposer of problem choices, or of mixtures."""
    env = meta_env(**({"actions": mixture()} if mix else {}), **options)
    settings = PPOSettings(horizon=env.steps, gamma=1.0, epochs=2)
    advantage = LeaveOneOutBaseline(1.0) if mix else None
    ppo = PPO(env, proposer_agent(mix), settings, advantage=advantage)
    return c.ProposerTrainer(ppo).curriculum(own_action)


def frozen(learnt: c.ProposerCurriculum) -> c.ProposerCurriculum:
    """The same Proposer, learning no more."""
    return c.ProposerCurriculum(
        learnt.agent,
        learnt.view,
        learnt.actions,
        meta_episode_length=learnt.meta_episode_length,
        action_repeat=learnt.action_repeat,
        own_action=learnt.own_action,
    )


def weights(curriculum: c.ProposerCurriculum) -> TensorDict:
    assert curriculum.trainer is not None
    return curriculum.trainer.learner.snapshot()


def improved(**options: Any) -> tuple[c.ProposerCurriculum, c.TaskStudent]:
    """A Proposer that has learnt for a cycle, and its student."""
    curriculum, solver = proposer(**options), student()
    curriculum.improve(solver, cycle(0))
    return curriculum, solver


def test_a_proposer_may_begin_within_a_cycle() -> None:
    stages = [c.SamplingCurriculum(SPACE), proposer(mix=True, action_repeat=L)]
    curriculum = c.Schedule(stages, [1])
    curriculum.improve(student(), cycle(0))
    for updates in range(3):
        batch = curriculum.propose(student(), P, cycle(updates))
        assert batch.levels.batch_size == (P,)
    assert stages[1].state_dict()["proposed"] == 2


def test_improving_reports_gains_cost_and_proposals() -> None:
    curriculum = proposer(reward=log_success_gain)
    before = weights(curriculum)
    solver = student()
    untrained = solver.snapshot()
    metrics = curriculum.improve(solver, cycle(0))
    assert solver.frames == K * P * 8 * L
    assert solver.evaluations == K * (L + 1) * E
    assert len(metrics["return_gain"]) == len(metrics["log_success_gain"]) == K
    # What is paid is this gain, so over an episode both add up to the same; not to the other.
    assert metrics["total_reward"] == pytest.approx(metrics["log_success_gain"], abs=1e-5)
    assert metrics["total_reward"] != pytest.approx(metrics["return_gain"], abs=1e-3)
    assert metrics["reward_sd"] == pytest.approx(np.std(metrics["total_reward"]), abs=1e-6)
    assert np.shape(metrics["histogram"]) == (2, 2)  # fractions, lengths
    assert np.sum(metrics["histogram"]) == K * L * P
    assert not (weights(curriculum) == before).all()
    assert (solver.snapshot() == untrained).all()


def test_proposing_costs_an_evaluation_where_an_action_begins() -> None:
    curriculum, solver = improved(**HELD)
    costs = []
    for _ in range(4):
        solver.frames, solver.evaluations = 0, 0
        curriculum.propose(solver, P, update(0))
        costs.append((solver.frames, solver.evaluations))
    assert costs == [(0, E), (0, 0), (0, E), (0, 0)]


def test_a_restored_proposer_proposes_and_improves_alike() -> None:
    """Also in the middle of an action; tests/curricula/test_contract.py has problem choices."""
    original, solver = improved(**HELD)
    original.propose(solver, P, update(0))
    resumed = proposer(**HELD)
    resumed.load_state_dict(original.state_dict())
    came = []
    for curriculum in (original, resumed):
        # Where an action holds for two updates, that of the second is the first's.
        levels = [curriculum.propose(solver, P, update(number)) for number in (1, 2)]
        came.append((levels, curriculum.improve(solver, cycle(1)), weights(curriculum)))
    (levels, metrics, learnt), (other_levels, other_metrics, other_learnt) = came
    assert all((one == other).all() for one, other in zip(levels, other_levels, strict=True))
    assert metrics == other_metrics and (learnt == other_learnt).all()


def test_an_own_action_holds_and_a_mode_is_no_matter_of_chance() -> None:
    actions = {}
    for own in ("sample", "mode"):
        curriculum, solver = improved(own_action=own, **HELD)
        actions[own] = []
        for number in range(4):
            curriculum.propose(solver, P, update(number))
            actions[own].append(curriculum.state_dict()["action"])
    first, same, other, _ = actions["sample"]
    assert torch.equal(first, same) and not torch.equal(first, other)
    expected = curriculum.agent(curriculum.view.observe(solver._learner.agent, 0.5))["logits"][
        ..., 0
    ]
    torch.testing.assert_close(actions["mode"][2], expected)


@pytest.mark.parametrize("own", ["sample", "mode"])
def test_a_frozen_one_proposes_what_was_learnt_and_learns_no_more(own: str) -> None:
    learnt, solver = improved(own_action=own)
    # Another network with its weights, as from a checkpoint.
    agent = proposer_agent(mix=False)
    load_agent(agent, weights(learnt))
    env = meta_env()
    loaded = c.ProposerCurriculum(
        agent, env.view, env.actions, meta_episode_length=L, action_repeat=1, own_action=own
    )
    before = weights(learnt)
    assert loaded.improve(solver, cycle(0)) == {}
    for number in range(3):
        expected = learnt.propose(solver, P, update(number))
        assert (loaded.propose(solver, P, update(number)) == expected).all()
    assert (weights(learnt) == before).all()


def test_a_frozen_one_goes_on_with_its_own_weights() -> None:
    """Whatever has become of the checkpoint that they came from."""
    curriculum = frozen(proposer())
    state, before = curriculum.state_dict(), agent_weights(curriculum.agent)
    resumed = frozen(proposer())
    for weight in resumed.agent.parameters():
        weight.data.zero_()
    resumed.load_state_dict(state)
    assert (agent_weights(resumed.agent) == before).all()


def test_a_cycle_beyond_the_episodes_that_it_learnt_in_begins_another(monkeypatch) -> None:
    curriculum, solver, seen = frozen(proposer(**HELD)), student(), []
    observation = curriculum.view.observation

    def noted(*given: Any) -> TensorDict:
        seen.append(given[-1])
        return observation(*given)

    monkeypatch.setattr(curriculum.view, "observation", noted)
    for number in range(10):
        curriculum.propose(solver, P, update(number))
    assert seen == [0, 0.5, 0, 0.5, 0]  # four updates of an episode, two of an action


def test_a_frozen_proposer_refuses_weights_of_another_network() -> None:
    with pytest.raises(ValueError, match="belongs to another network"):
        load_agent(proposer_agent(mix=True), weights(proposer()))


def test_refuses_what_does_not_fit() -> None:
    with pytest.raises(ValueError, match="horizon 4 must be the meta-environment's number of"):
        c.ProposerTrainer(PPO(meta_env(), proposer_agent(mix=False), PPOSettings(horizon=4)))

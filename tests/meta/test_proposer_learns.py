"""The unchanged Proposer, collector and loss on a Solver whose best curriculum is known."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import nn

from proposer_rl import models
from proposer_rl.learning import PPO, LeaveOneOutBaseline, PPOSettings
from proposer_rl.meta.actions import ProblemChoices
from proposer_rl.streams import Streams
from tests.skill_ladder import any_mixture, best_constant, best_sequence, ladder_env

SKILLS, UPDATES, COPIES, PROBLEMS = 3, 6, 16, 16


def problem_choices() -> PPO:
    """The paper's Proposer: every problem's choice is an action, a critic gives the advantage."""
    env = ladder_env(ProblemChoices, copies=COPIES, problems=PROBLEMS, meta_episode_length=UPDATES)
    return ppo(env, models.ProblemHead(33, PROBLEMS, SKILLS, hidden=32), models.categorical, None)


def mixtures(idle: int = 0, action_repeat: int = 1, shuffled: bool = False, epochs: int = 4) -> PPO:
    """Mixtures as actions; the other replicas give the advantage."""
    lengths = {"meta_episode_length": UPDATES, "action_repeat": action_repeat}
    size = {"copies": COPIES, "problems": PROBLEMS, "idle": idle}
    env = ladder_env(any_mixture, shuffled=shuffled, **size, **lengths)
    head, baseline = models.MixtureHead(33, SKILLS + idle, hidden=32), LeaveOneOutBaseline(1.0)
    return ppo(env, head, models.normal, baseline, epochs)


def ppo(env, head, distribution, advantage, epochs: int = 4) -> PPO:
    network = models.ProposerNetwork(head, nn.Linear(SKILLS, 32), numbers=1, context=32, hidden=32)
    agent = models.proposer_actor_critic(network, distribution, ["probes", "progress"])
    settings = PPOSettings(horizon=env.steps, gamma=1.0, epochs=epochs, learning_rate=1e-2)
    return PPO(env, agent, settings, advantage=advantage)


def learnt_gain(make: Callable[..., PPO], cycles: int = 45, **options) -> float:
    """Mean total gain of the last ten cycles, each from a beginner."""
    streams = Streams(0)
    with streams.as_default("weights"):
        proposer = make(**options)
    beginner, gains = proposer.env.solvers.snapshot()[0], []
    for cycle in range(cycles):
        proposer.env.fork(beginner, streams.within(cycle))
        generators = [streams.generator(cycle, "proposals", k) for k in range(COPIES)]
        rollout = proposer.update(generators).rollout
        gains.append((rollout["next", "return"][:, -1] - rollout["return"][:, 0]).mean())
    return float(torch.stack(gains[-10:]).mean())


@pytest.mark.parametrize("make", [problem_choices, mixtures])
def test_it_finds_the_best_curriculum(make: Callable[..., PPO]) -> None:
    assert learnt_gain(make) > 0.9 * best_sequence(SKILLS, UPDATES)


@pytest.mark.slow
def test_it_finds_the_best_mixture_where_one_action_holds_for_an_episode() -> None:
    best = best_constant(SKILLS, UPDATES, PROBLEMS)
    held = {"idle": SKILLS, "action_repeat": UPDATES, "epochs": 8}
    assert learnt_gain(mixtures, cycles=80, **held) > 0.9 * best


def test_it_does_not_when_the_rewards_are_shuffled_between_copies() -> None:
    assert learnt_gain(mixtures, shuffled=True) < 0.4 * best_sequence(SKILLS, UPDATES)

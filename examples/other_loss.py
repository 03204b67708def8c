"""Train the Proposer with other losses of TorchRL's: A2CLoss and ReinforceLoss.

A method takes a function that makes the loss from actor and critic. These two losses are valid only
for the policy that collected the rollout, so that each takes a single gradient step, larger than
PPO's. Everything else is as with PPO, including advantages relative to the other replicas.

    python examples/other_loss.py [cycles]

On the command line, by a method that is a function of a run (examples/conf/method/a2c.yaml):

    PYTHONPATH=examples bin/train --config-dir examples/conf +method=a2c +scale=quick \
        proposer.ppo.epochs=1 proposer.ppo.updates=1 proposer.ppo.learning_rate=0.01
"""

from __future__ import annotations

import sys

import torch
from mountain_car import MountainCarTask
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torchrl.objectives import A2CLoss, ReinforceLoss

from proposer_rl import ComputeContext, PPOSettings, SolverSettings, Streams, performance_gain
from proposer_rl.curricula import ProposerCurriculum, TaskStudent
from proposer_rl.learning import LearningSettings
from proposer_rl.meta.assembly import ProposerSettings
from proposer_rl.methods import Components, proposer

UPDATES = 20


def a2c(actor: TensorDictModuleBase, critic: TensorDictModule) -> A2CLoss:
    """Make A2C's loss (Mnih et al. 2016); actions of kind ``problems`` need ``ratio=joint``."""
    return A2CLoss(
        actor, critic, functional=False, reduction="none", critic_coeff=0.5, loss_critic_type="l2"
    )


def reinforce(actor: TensorDictModuleBase, critic: TensorDictModule) -> ReinforceLoss:
    """Make REINFORCE's loss (Williams 1992)."""
    return ReinforceLoss(actor, critic, functional=False, reduction="none", loss_critic_type="l2")


def a2c_proposer(run: Components) -> ProposerCurriculum:
    """Make the curriculum; the command line names this function."""
    return proposer(run, a2c, reward=performance_gain)


def main(cycles: int = 20) -> None:
    """Train a Proposer for mountain cars with each; every cycle begins with a new Solver."""
    torch.set_num_threads(1)
    ppo = PPOSettings(horizon=40, learning_rate=4e-3)
    task = MountainCarTask(
        levels=64, solver=SolverSettings(batch_size=16, ppo=ppo), context=ComputeContext()
    )
    settings = ProposerSettings(
        meta_episode_length=UPDATES,
        action_repeat=UPDATES // 2,
        validation_levels=64,
        context=32,
        hidden=32,
        ppo=LearningSettings(epochs=1, gamma=1.0, learning_rate=0.02),
    )
    for loss in (a2c, reinforce):
        run = Components(task, settings, seed=0)
        curriculum = proposer(run, loss, reward=performance_gain)
        for cycle in range(cycles):
            stream = Streams(0, cycle)
            student = TaskStudent(task, task.learner([stream]))
            outcome = curriculum.improve(student, stream)
            gain = sum(outcome["return_gain"]) / len(outcome["return_gain"])
            print(f"{loss.__name__}, cycle {cycle}: mean gain of the replicas {gain:.2f}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))

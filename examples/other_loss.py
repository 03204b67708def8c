"""The Proposer trained with other losses of TorchRL's: A2CLoss and ReinforceLoss.

A method takes a factory of the loss, called with actor and critic. These two hold only for the
policy that collected the rollout, so each gets one gradient step on it, and a larger one than
PPO's. All else is as with PPO, also the advantages against the other copies.

    python examples/other_loss.py [cycles]

On the command line a method is a function that takes a run (examples/conf/method/a2c.yaml):

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
    """Mnih et al. 2016. It takes an action as one event: ``problems`` need ``ratio=joint``."""
    return A2CLoss(
        actor, critic, functional=False, reduction="none", critic_coeff=0.5, loss_critic_type="l2"
    )


def reinforce(actor: TensorDictModuleBase, critic: TensorDictModule) -> ReinforceLoss:
    """Williams 1992."""
    return ReinforceLoss(actor, critic, functional=False, reduction="none", loss_critic_type="l2")


def a2c_proposer(run: Components) -> ProposerCurriculum:
    """The method that the command line names."""
    return proposer(run, a2c, reward=performance_gain)


def main(cycles: int = 20) -> None:
    """Train a Proposer for mountain cars with each; every cycle begins with a fresh Solver."""
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

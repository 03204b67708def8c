"""Train a Proposer of your own by TorchRL's Collector, GAE and ClipPPOLoss on SolverTrainingEnv.

The task is that of own_task.py, the policy and the reward are here. A step of this environment
trains a batch of Solvers, the replicas, on what the Proposer proposes. Where they start is for you
to say, by ``fork``: here a new Solver begins at every third cycle; until then it goes on from where
its first replica got to.

    python examples/stock_proposer.py [cycles]
"""

from __future__ import annotations

import sys

import torch
from own_task import SledgeTask
from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictSequential
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from proposer_rl import (
    ComputeContext,
    Mixture,
    PPOSettings,
    SolverSettings,
    SolverTrainingEnv,
    SolverView,
    Streams,
)
from proposer_rl.meta.rewards import TrainingStep

REPLICAS, UPDATES, STEPS = 8, 20, 4  # updates and steps of an episode of the Proposer
CYCLES_OF_A_SOLVER = 3
OBSERVED = ["return", "progress"]


def worst_levels_gain(step: TrainingStep) -> Tensor:
    """Return how much an update raised the returns on the worst half of the target, [K]."""
    before, after = (seen["return"].sort(1).values for seen in (step.before, step.after))
    half = before.shape[1] // 2
    return (after - before)[:, :half].mean(1)


def small_task() -> SledgeTask:
    """Make a task whose Solvers train on 16 sledges at a time."""
    solver = SolverSettings(batch_size=16, ppo=PPOSettings(horizon=40, learning_rate=4e-3))
    return SledgeTask(levels=64, solver=solver, context=ComputeContext())


def environment(task: SledgeTask) -> SolverTrainingEnv:
    """Make the environment, whose actions are mixtures of distances and winds."""
    return SolverTrainingEnv(
        task.learner([Streams(0)] * REPLICAS),
        view=SolverView(task, validation_levels=64, probe_levels=4),
        actions=Mixture(task.space),
        reward=worst_levels_gain,
        meta_episode_length=UPDATES,
        action_repeat=UPDATES // STEPS,
    )


def new_solver(task: SledgeTask, number: int) -> TensorDictBase:
    """Return an untrained Solver: its weights and the state of its optimiser."""
    return task.learner([Streams(1, number)]).snapshot()[0]


def main(cycles: int = 30) -> None:
    """Train the Proposer; print what its Solvers reach at the end of each cycle."""
    torch.manual_seed(0)
    task = small_task()
    env = environment(task)
    numbers = 2 * env.action_spec.shape[-1]
    actor = ProbabilisticActor(
        TensorDictSequential(
            TensorDictModule(MLP(len(OBSERVED), numbers, num_cells=[32]), OBSERVED, ["numbers"]),
            TensorDictModule(NormalParamExtractor(), ["numbers"], ["loc", "scale"]),
        ),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    critic = ValueOperator(MLP(len(OBSERVED), 1, num_cells=[32]), OBSERVED)
    collector = Collector(
        env,
        actor,
        frames_per_batch=REPLICAS * STEPS,
        total_frames=-1,
        reset_at_each_iter=True,  # so that an episode begins with the Solver of fork
        auto_register_policy_transforms=False,
    )
    advantage = GAE(gamma=1.0, lmbda=0.95, value_network=critic)
    loss = ClipPPOLoss(actor, critic, normalize_advantage=True)
    optimiser = torch.optim.Adam(loss.parameters(), lr=3e-3)
    for cycle in range(cycles):
        if cycle % CYCLES_OF_A_SOLVER == 0:
            solver = new_solver(task, cycle)
        env.fork(solver, Streams(2, cycle))
        batch = collector.rollout()  # [REPLICAS, STEPS]
        solver = env.solvers.snapshot()[0]
        for _ in range(8):
            with torch.no_grad():
                advantage(batch)
            terms = loss(batch)
            optimiser.zero_grad()
            sum(terms[key] for key in terms.keys() if key.startswith("loss_")).backward()
            optimiser.step()
        reached, gain = batch["next", "return"][:, -1].mean(), batch["next", "reward"].sum(1).mean()
        print(f"cycle {cycle}: return {reached:.2f}, worst half {gain:+.2f}")
    collector.shutdown()


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))

"""Write your own learner for the meta-environment: softmax regression, without PPO and episodes.

The meta-environment trains K learners side by side on what a policy proposes, and rewards the
policy for what they learn. :class:`proposer_rl.meta.env.Learner` lists what a learner must have;
`task` below is all that is needed of a task. A level is an example to learn from, a bin its class.

    python examples/own_learner.py
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn import functional

from proposer_rl import Mixture, SolverTrainingEnv, SolverView, Streams, performance_gain
from proposer_rl.learning import Update

MEANS = torch.tensor([[0.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])  # of three classes in the plane


class Examples:
    """A space whose levels are examples of the three classes."""

    size, axes = 3, {"class": [0.0, 1.0, 2.0]}
    coordinates = torch.tensor([[-1.0], [0.0], [1.0]])

    def generate(self, choices: Tensor, generators: list[torch.Generator]) -> TensorDict:
        """Draw points [K, P] around the means of their classes, of learner k from generator k."""
        noise = [torch.randn(choices.shape[1], 2, generator=g) for g in generators]
        point = MEANS[choices] + 0.5 * torch.stack(noise)
        return TensorDict({"point": point, "label": choices}, choices.shape)

    def sample(self, count: int, generator: torch.Generator) -> TensorDict:
        """Draw from the target, all classes alike."""
        return self.generate(torch.randint(3, (1, count), generator=generator), [generator])[0]


class SoftmaxRegression:
    """K classifiers, each of which learns by gradient descent on P examples at a time."""

    horizon = 1  # a step on each example

    def __init__(self, copies: int, batch_size: int, rate: float = 0.1) -> None:
        self.copies, self.rate = copies, rate
        self.agent = torch.zeros(copies, 2, 3)  # weights, which the task reads
        self.env: Any = SimpleNamespace(
            batch_size=torch.Size([copies, batch_size]),
            device=torch.device("cpu"),
            set_levels=lambda examples: setattr(self, "examples", examples),
        )

    def update(self, generators: list[torch.Generator]) -> Update:
        """Take a step down the mean cross-entropy of each."""
        error = functional.one_hot(self.examples["label"], 3) - logits(
            self.agent, self.examples
        ).softmax(-1)
        self.agent += self.rate * self.examples["point"].mT @ error / error.shape[1]
        return Update(self.examples, TensorDict({}, [self.copies]))

    def check(self, first: int = 0) -> None:
        """Do nothing, as nothing here can diverge."""

    def snapshot(self) -> TensorDict:
        """Return a copy of the weights, [K]."""
        return TensorDict({"weights": self.agent.clone()}, [self.copies])

    def restore(self, snapshot: TensorDictBase) -> None:
        """Put weights back."""
        self.agent = snapshot["weights"].clone()


def logits(weights: Tensor, examples: TensorDictBase) -> Tensor:
    """Return logits of K classifiers on examples [n] or each on its own [K, n]: [K, n, 3]."""
    return examples["point"] @ weights


def task() -> Any:
    """Make the task that the view of the learners needs, with log-likelihood as the return."""

    def performance(weights: Tensor, examples: TensorDictBase, _: object) -> TensorDict:
        log = logits(weights, examples).log_softmax(-1)
        label = examples["label"].expand(log.shape[:2]).unsqueeze(-1)
        return TensorDict({"return": log.gather(-1, label).squeeze(-1)}, log.shape[:2])

    return SimpleNamespace(
        device=torch.device("cpu"), target=Examples(), performance=performance, probe=logits
    )


def meta_environment(copies: int = 4, updates: int = 20) -> SolverTrainingEnv:
    """Make the environment, in which a step is so many updates on 16 examples each."""
    return SolverTrainingEnv(
        SoftmaxRegression(copies, batch_size=16),
        view=SolverView(task(), validation_levels=256, probe_levels=4),
        actions=Mixture(Examples()),
        reward=performance_gain,
        meta_episode_length=updates,
        action_repeat=updates,
    )


def main() -> None:
    """Print the reward of an episode on all classes alike, and of one on the first class."""
    env = meta_environment()
    env.fork(env.solvers.snapshot()[0], Streams(0))
    for name, number in (("all classes alike", 0.0), ("the first class above all", -20.0)):
        env.reset()
        step = env.step(TensorDict({"action": torch.full((4, 1), number)}, [4]))
        print(f"{name}: log-likelihood +{float(step['next', 'reward'].mean()):.3f}")


if __name__ == "__main__":
    main()

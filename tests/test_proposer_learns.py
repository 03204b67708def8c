"""The unchanged Proposer, collector and loss on a meta-environment whose best answer is known."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from proposer_rl.models import ProposerNetwork, proposer_actor_critic
from proposer_rl.ppo import PPO, PPOSettings
from proposer_rl.streams import Streams

K, P, N, L = 16, 4, 4, 5


class WorthOfChoices(EnvBase):
    """Pays the mean worth of the P choices; which choice is worth most is seen in the probes.

    ``shuffled`` pays every copy what another one earned.
    """

    def __init__(self, shuffled: bool = False) -> None:
        super().__init__(batch_size=[K])
        self.shuffled = shuffled
        self.observation_spec = Composite(probes=Unbounded((K, 1, N, 4, 4)), shape=[K])
        self.action_spec = Categorical(N, shape=(K, P), dtype=torch.int64)
        self.reward_spec = Unbounded((K, 1))
        flag = Categorical(2, shape=(K, 1), dtype=torch.bool)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), shape=[K])
        self.best = torch.arange(K) % N  # copy k's best choice is k mod N

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        self.steps = 0
        return self._observe(False)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.steps += 1
        worth = (tensordict["action"] == self.best[:, None]).float().mean(-1, keepdim=True)
        paid = worth.roll(1, 0) if self.shuffled else worth
        return self._observe(self.steps == L).set("reward", paid)

    def _observe(self, done: bool) -> TensorDict:
        shown = torch.nn.functional.one_hot(self.best, N).float()[:, None, :, None, None]
        flag = torch.full((K, 1), done)
        probes = shown.expand(K, 1, N, 4, 4)
        return TensorDict({"probes": probes, "done": flag, "terminated": flag.clone()}, [K])

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is random."""


def final_worth(seed: int, shuffled: bool = False) -> float:
    """Mean worth of the choices after training; chance is 1 / N, the best is 1."""
    with Streams(seed).as_default("weights"):
        network = ProposerNetwork(N, P, N, context=32, hidden=32, channels=(8,))
    settings = PPOSettings(horizon=L, updates=1, epochs=8, gamma=1.0, learning_rate=3e-3)
    ppo = PPO(WorthOfChoices(shuffled), proposer_actor_critic(network), settings)
    for cycle in range(80):
        rollout = ppo.update([Streams(seed).generator(cycle, k) for k in range(K)]).rollout
    chosen: Tensor = rollout["action"] == ppo.env.best[:, None, None]
    return float(chosen.float().mean())


def test_the_proposer_finds_the_best_choice_for_the_solver_that_it_sees() -> None:
    assert min(final_worth(seed) for seed in (0, 1)) > 0.9


def test_it_does_not_when_the_rewards_are_shuffled_between_copies() -> None:
    assert final_worth(0, shuffled=True) < 0.4

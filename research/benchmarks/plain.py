"""PPO on mazes in the plain TorchRL way: the reference that the library's own is timed against.

It is what the tutorials teach: an observation with the maze's planes at every step, a network that
maps an observation to logits and a value, ``Collector``, ``GAE`` and ``ClipPPOLoss``,
one forward pass per transition, float32 in torch's default layout. Where a choice is left, the
faster one is taken: actor and critic share one forward pass of their trunk, and advantages reuse
the values that were computed while acting.

The numbers are those of :class:`~proposer_rl.learning.ppo.PPO` (a test compares them).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from proposer_rl.learning import PPOSettings


class PlainUNet(nn.Module):
    """The Solver's U-Net as it is usually written; parameters in the order of the library's."""

    def __init__(
        self,
        channels: Sequence[int] = (64, 128, 256),
        in_channels: int = 3,
        actions: int = 4,
        groups: int = 8,
    ) -> None:
        super().__init__()
        fine, middle, coarse = channels
        self.down1 = double_conv(in_channels, fine, groups)
        self.down2 = double_conv(fine, middle, groups)
        self.down3 = double_conv(middle, coarse, groups)
        self.up2 = double_conv(coarse + middle, middle, groups)
        self.up1 = double_conv(middle + fine, fine, groups)
        self.policy = nn.Conv2d(fine, actions, 1)
        self.value = nn.Conv2d(fine, 1, 1)
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d):
                nn.init.orthogonal_(layer.weight, 2**0.5)

    def forward(self, planes: Tensor) -> tuple[Tensor, Tensor]:
        """Map planes [N, C, H, W] to policy maps [N, A, H, W] and value maps [N, 1, H, W]."""
        fine = self.down1(planes)
        middle = self.down2(F.max_pool2d(fine, 2))
        coarse = self.down3(F.max_pool2d(middle, 2))
        x = self.up2(torch.cat([middle, enlarge(coarse, middle)], 1))
        x = self.up1(torch.cat([fine, enlarge(x, fine)], 1))
        return self.policy(x), self.value(x)


def double_conv(in_channels: int, out_channels: int, groups: int) -> nn.Sequential:
    """Twice: 3x3 convolution, GroupNorm, ReLU."""
    return nn.Sequential(
        nn.Conv2d(in_channels, out_channels, 3, padding=1),
        nn.GroupNorm(groups, out_channels),
        nn.ReLU(),
        nn.Conv2d(out_channels, out_channels, 3, padding=1),
        nn.GroupNorm(groups, out_channels),
        nn.ReLU(),
    )


def enlarge(x: Tensor, like: Tensor) -> Tensor:
    """Interpolate bilinearly to another tensor's height and width."""
    return F.interpolate(x, like.shape[-2:], mode="bilinear")


class ReadAtAgent(nn.Module):
    """Logits [*B, A] and value [*B, 1] of observations [*B]: a network's maps at the agent."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, planes: Tensor, agent: Tensor) -> tuple[Tensor, Tensor]:
        """Run the network on each observation's planes and read at the agent's cell."""
        maps = torch.cat(self.network(planes.flatten(0, -4)), 1)
        row, column = agent.flatten(0, -2).unbind(-1)
        read = maps[torch.arange(len(maps), device=maps.device), :, row, column]
        read = read.unflatten(0, planes.shape[:-3])
        return read[..., :-1], read[..., -1:]


class PlainPPO:
    """Collector, advantages and loss around one network.

    Args:
        env: mazes [P].
        network: maps planes to policy and value maps.
        settings: PPO's numbers, the same as the library's.
    """

    def __init__(self, env: EnvBase, network: nn.Module, settings: PPOSettings) -> None:
        self.env = env
        self.settings = settings
        self.network = network.to(env.device)
        self.module = TensorDictModule(
            ReadAtAgent(self.network), ["planes", "agent"], ["logits", "state_value"]
        )
        actor = ProbabilisticActor(
            self.module,
            in_keys=["logits"],
            distribution_class=torch.distributions.Categorical,
            return_log_prob=True,
        )
        self._collector = Collector(
            env,
            actor,
            frames_per_batch=env.batch_size.numel() * settings.horizon,
            total_frames=-1,
            reset_at_each_iter=True,
            auto_register_policy_transforms=False,
        )
        self._gae = GAE(gamma=settings.gamma, lmbda=settings.lmbda, value_network=None)
        # The loss reads logits and values that one pass of the module has written.
        logits = TensorDictModule(nn.Identity(), ["logits"], ["logits"])
        sample = ProbabilisticTensorDictModule(
            ["logits"],
            ["action"],
            distribution_class=torch.distributions.Categorical,
            return_log_prob=True,
        )
        self._loss = ClipPPOLoss(
            ProbabilisticTensorDictSequential(logits, sample),
            TensorDictModule(nn.Identity(), ["state_value"], ["state_value"]),
            clip_epsilon=settings.clip_epsilon,
            entropy_coeff=settings.entropy_coeff,
            critic_coeff=settings.critic_coeff,
            loss_critic_type="l2",
            normalize_advantage=settings.normalize_advantage,
        ).to(env.device)
        self._adam = torch.optim.Adam(
            self.network.parameters(), lr=settings.learning_rate, eps=settings.adam_eps
        )

    def update(self) -> None:
        """Collect a batch and train on it."""
        rollout = self.collect()
        self.advantages(rollout)
        for _ in range(self.settings.epochs):
            self.epoch(rollout)

    def collect(self) -> TensorDictBase:
        """Transitions [P, T] of the present policy, from each maze's start."""
        return self._collector.rollout()

    @torch.no_grad()
    def advantages(self, rollout: TensorDictBase) -> TensorDictBase:
        """Write the next states' values, ``advantage`` and ``value_target`` into the rollout.

        The states' own values are there from the collection.
        """
        following = self.module(rollout["next"].select("planes", "agent"))
        rollout["next", "state_value"] = following["state_value"]
        return self._gae(rollout)

    def epoch(self, rollout: TensorDictBase) -> dict[str, Tensor]:
        """One gradient step on all transitions; returns the loss's terms."""
        losses = self._loss(self.module(rollout.copy()))
        terms = {key: losses[f"loss_{key}"] for key in ("objective", "critic", "entropy")}
        self._adam.zero_grad()
        torch.stack(list(terms.values())).sum().backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), self.settings.max_grad_norm)
        self._adam.step()
        return terms

"""Advantages: by a critic, or by the other replicas."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.objectives.value import GAE
from torchrl.objectives.value.functional import reward2go

LEAST_DISCOUNT = 1e-7  # below it, float32 does not know the next reward from none


def gae(gamma: float, lmbda: float, value_key: str) -> GAE:
    """TorchRL's generalised advantage estimation, of values that stand in the rollout."""
    # Its vectorised form splits the batch where episodes end, which it has to look up.
    estimator = GAE(gamma=gamma, lmbda=lmbda, value_network=None, vectorized=False)
    estimator.set_keys(value=value_key)
    return estimator


class LeaveOneOutBaseline(TensorDictModuleBase):
    """The return to come, minus what the other replicas had to come at the same step.

    Where all K episodes start from one state, the others' mean return is an unbiased estimate of
    that state's value, and a far better one than a critic that has seen a few episodes
    (Kool et al. 2019, "Buy 4 REINFORCE samples, get a baseline for free!", eq. 8). It takes the
    place of :class:`torchrl.objectives.value.GAE`: the returns are the critic's targets.

    Args:
        gamma: discount.

    Raises:
        ValueError: when called on fewer than two replicas.

    Example:
        Three replicas, one step each:

        >>> reward = torch.tensor([1.0, 2.0, 6.0]).view(3, 1, 1)
        >>> from tensordict import TensorDict
        >>> rollout = TensorDict({"next": {"reward": reward, "done": reward > 0}}, [3, 1])
        >>> LeaveOneOutBaseline(gamma=1.0)(rollout)["advantage"].flatten()
        tensor([-3.0000, -1.5000,  4.5000])
    """

    def __init__(self, gamma: float) -> None:
        super().__init__()
        self.in_keys = [("next", "reward"), ("next", "done")]
        self.out_keys = ["advantage", "value_target"]
        self.gamma = gamma

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``advantage`` and ``value_target``, [K, T, 1], into a rollout [K, T]."""
        copies = tensordict.batch_size[0]
        if copies < 2:
            raise ValueError("a baseline from the other copies needs at least 2 copies, got 1")
        reward = tensordict["next", "reward"]
        # TorchRL's sum breaks off where a power of the discount is lost in rounding: here before
        # the first term.
        following = reward.clone()
        if self.gamma >= LEAST_DISCOUNT:
            following = reward2go(reward, tensordict["next", "done"], self.gamma)
        others = (following.sum(0, keepdim=True) - following) / (copies - 1)
        tensordict.set("advantage", following - others)
        return tensordict.set("value_target", following)

"""Running moments of what an agent sees and of its rewards, one set for each of K replicas.

TorchRL's ``VecNormV2`` has one set for a whole batch of environments or one for each of them, and
none for each row; and what a transform of an environment knows, an agent that is evaluated
elsewhere does not. So they belong to the agent here, and stand still but where it trains.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

FARTHEST = 10.0
"""Standard deviations from the mean at which a normalised number ends, as is usual."""

TINY = 1e-8  # added to variances


class RunningMoments(nn.Module):
    """Mean and variance of all numbers so far, those of each replica by themselves.

    Merged by Chan et al. 1983 ("Algorithms for computing the sample variance"), in float64, of
    whatever has the shape S.
    """

    count: Tensor
    mean: Tensor
    variance: Tensor

    def __init__(self, copies: int | None, shape: Sequence[int]) -> None:
        super().__init__()
        rows = [] if copies is None else [copies]
        self._lead = len(rows)
        zeros = torch.zeros(*rows, *shape, dtype=torch.float64)
        self.register_buffer("count", torch.zeros(rows, dtype=torch.float64))
        self.register_buffer("mean", zeros)
        self.register_buffer("variance", torch.ones_like(zeros))

    def update(self, values: Tensor) -> None:
        """Updates the moments by numbers [K, *B, *S], or without replicas [*B, *S]."""
        shape = self.mean.shape[self._lead :]
        rows = values.detach().double().reshape(*self.mean.shape[: self._lead], -1, *shape)
        new = rows.shape[self._lead]
        mean, variance = rows.mean(self._lead), rows.var(self._lead, correction=0)
        before = self.count.reshape(*self.count.shape, *[1] * len(shape))
        share = new / (before + new)
        apart = mean - self.mean
        # At first there is no variance, whatever stands there.
        self.variance.copy_(
            (1 - share) * self.variance + share * variance + share * (1 - share) * apart.square()
        )
        self.mean.add_(share * apart)
        self.count.add_(new)

    @property
    def deviation(self) -> Tensor:
        """Returns the standard deviation, float32 [K, *S]; 1 before the first numbers."""
        return (self.variance + TINY).sqrt().float()

    def forward(self, values: Tensor) -> Tensor:
        """Returns numbers [K, *B, *S] less their mean, in standard deviations, cut off far out."""
        mean, deviation = (self.along(each, values) for each in (self.mean, self.deviation))
        return ((values - mean.float()) / deviation).clamp(-FARTHEST, FARTHEST)

    def along(self, moments: Tensor, values: Tensor) -> Tensor:
        """Returns moments [K, *S], to be broadcast against values [K, *B, *S]."""
        between = values.ndim - moments.ndim
        lead = moments.shape[: self._lead]
        return moments.reshape(*lead, *[1] * between, *moments.shape[self._lead :])


class Normalization(nn.Module):
    """Running standardisation of an agent's observations and of the unit of its values.

    Rewards stay what they are. Instead the critic's outputs are multiplied with the standard
    deviation of the discounted return, and its loss is taken in that unit: the same as rewards
    divided by it, while values can be read without knowing of the unit.

    ``observations`` are the shapes of the entries that are normalised, by name.
    """

    def __init__(
        self, copies: int | None, observations: Mapping[str, Sequence[int]], *, rewards: bool
    ) -> None:
        super().__init__()
        self.observations = nn.ModuleDict(
            {name: RunningMoments(copies, shape) for name, shape in observations.items()}
        )
        self.returns = RunningMoments(copies, []) if rewards else None

    def seen(self, inputs: TensorDictBase) -> TensorDictBase:
        """Returns a copy of a tensordict [K, *B] with its observations normalised."""
        shown = inputs.copy()
        for name, moments in self.observations.items():
            shown.set(name, moments(inputs.get(name)))
        return shown

    def unit(self, values: Tensor) -> Tensor:
        """Returns the unit of values [K, *B, 1], to be broadcast against them; 1 for none."""
        if self.returns is None:
            return values.new_ones(())
        return self.returns.along(self.returns.deviation, values)

    def update_observations(self, observed: TensorDictBase) -> None:
        """Updates the moments by what was observed, [K, *B]."""
        for name, moments in self.observations.items():
            assert isinstance(moments, RunningMoments)
            moments.update(observed.get(name))

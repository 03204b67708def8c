"""What students would reach on any level: regressions on what came of those they trained on.

Every update ends with labelled data, levels and what came of them, that cost nothing more. Of the
last batches' rows phi_i with outcomes y_i, where what is ``age`` batches old has the weight

    w_i = 2 ** (-age_i / half_life),

a logistic regression gives the probability of success. Since students get better, one of the
features is -age_i / half_life, and 0 is what it is on the levels that are asked about: what was
true on average a half-life ago is carried forward to the present. The regression minimises

    sum_i w_i (log(1 + exp(z_i)) - y_i z_i) + ridge / 2 |beta|^2,    z_i = beta . phi_i.

With H = sum_i w_i p_i (1 - p_i) phi_i phi_i' + ridge I, the curvature at the minimum, beta is about
normal with the covariance H^-1 (Laplace's approximation), z of a level with s^2 = phi' H^-1 phi,
and the expectation of 1 / (1 + exp(-z)) about

    p = 1 / (1 + exp(-z / sqrt(1 + pi s^2 / 8)))

(MacKay 1992, "The evidence framework applied to classification networks", Neural Computation 4):
near one half where there are no data, whatever beta says.

The mean of the return comes from a linear regression. With r_i the returns, brought to mean 0 and
deviation 1 by their weights,

    minimise  sum_i w_i (r_i - a . phi_i)^2 + ridge |a|^2.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor

Labels = Literal["success", "above_worst"]

KEPT = 4  # half-lives, after which a batch is forgotten
STEPS = 50  # of Newton's method, at most
HALVINGS = 8  # of a step, at most, until it makes the loss no larger
CLOSE = 1e-10  # coefficients that change no more than this are found
EQUAL = 1e-6  # returns that differ no more than this are equal, in units of the worst one


def logistic_ridge(
    features: Tensor, labels: Tensor, weights: Tensor, ridge: float
) -> tuple[Tensor, Tensor]:
    """Fit K logistic regressions by Newton's method; all coefficients are penalised.

    Args:
        features: float64 [K, m, F].
        labels: in [0, 1], float64 [K, m].
        weights: of the rows, not negative, float64 [K, m].
        ridge: above 0.

    Returns:
        Coefficients beta, float64 [K, F], and their covariance, float64 [K, F, F].
    """
    prior = ridge * torch.eye(features.shape[-1], dtype=features.dtype)

    def at(beta: Tensor) -> tuple[Tensor, Tensor]:
        """Log odds [K, m], and the loss [K]."""
        z = _times(features, beta)
        misfit = torch.nn.functional.softplus(z) - labels * z
        return z, (weights * misfit).sum(-1) + ridge / 2 * beta.square().sum(-1)

    def curvature(p: Tensor) -> Tensor:
        return features.mT @ (features * (weights * p * (1 - p)).unsqueeze(-1)) + prior

    beta = features.new_zeros(len(features), features.shape[-1])
    z, now = at(beta)
    for _ in range(STEPS):
        p = z.sigmoid()
        slope = _times(features.mT, weights * (p - labels)) + ridge * beta
        step = torch.linalg.solve(curvature(p), slope)
        for halvings in range(HALVINGS + 1):
            z, then = at(beta - step)
            worse = then > now
            if halvings == HALVINGS or not worse.any():
                break
            step = torch.where(worse.unsqueeze(-1), step / 2, step)
        beta, now = beta - step, then
        if bool((step.abs() < CLOSE).all()):
            break
    return beta, torch.linalg.inv(curvature(z.sigmoid()))


def linear_ridge(features: Tensor, values: Tensor, weights: Tensor, ridge: float) -> Tensor:
    """Fit K linear regressions to values, float64 [K, m]; else as :func:`logistic_ridge`.

    Returns:
        Coefficients, float64 [K, F], all of which are penalised.
    """
    weighted = features.mT * weights.unsqueeze(1)
    prior = ridge * torch.eye(features.shape[-1], dtype=features.dtype)
    return torch.linalg.solve(weighted @ features + prior, _times(weighted, values))


class OutcomeModel:
    """What K students would reach on levels, by what came of the last batches.

    Args:
        labels: what the probability is of: ``"success"``, as outcomes tell it; or
            ``"above_worst"``, a return above the lowest that there ever was. Where failures all
            have the same return, the two are one. Where every step is rewarded, nearly every
            episode is above the worst: no level is silent, and each teaches something.
        ridge: on the coefficients.
        half_life: batches after which a row counts half.

    Attributes:
        reads: entries of an outcome that it takes in.
    """

    def __init__(
        self, *, labels: Labels = "success", ridge: float = 0.3, half_life: float = 12.0
    ) -> None:
        self._labels, self._ridge, self._half_life = labels, ridge, half_life
        # One that is not needed is not always told.
        self.reads = ("return", "success") if labels == "success" else ("return",)
        self._batches: list[dict[str, Tensor]] = []
        self._worst = torch.tensor(torch.inf, dtype=torch.float64)  # [K, 1], once there is a row
        self._fitted: _Fitted | None = None

    def add(self, features: Tensor, outcome: Mapping[str, Tensor], *, as_old: bool = False) -> None:
        """Take in a batch.

        Args:
            features: float64 [K, m, F]; a constant one is a further intercept.
            outcome: what it ``reads``, float64 [K, m].
            as_old: whether it is as old as the batch before it, and a part of that.
        """
        batch = {"features": features, **{name: outcome[name] for name in self.reads}}
        if as_old:
            *self._batches, before = self._batches
            batch = {name: torch.cat([before[name], batch[name]], 1) for name in batch}
        self._batches = [*self._batches, batch][-round(KEPT * self._half_life) :]
        self._worst = torch.minimum(self._worst, outcome["return"].amin(1, keepdim=True))
        self._fitted = None

    def predict(self, features: Tensor) -> TensorDict:
        """What to expect on levels with features float64 [K, n, F]: a tensordict [K, n].

        ``success`` and ``return``, each float64. Before there is any row they are 0.5 and 0
        everywhere.
        """
        shape = features.shape[:2]
        if not self._batches:
            same = {"success": 0.5, "return": 0.0}
            return TensorDict({k: features.new_full(shape, v) for k, v in same.items()}, shape)
        self._fitted = fitted = self._fitted or self._fit()
        phi = torch.cat([torch.zeros_like(features[..., :1]), features], -1)  # of age 0
        z = _times(phi, fitted.beta)
        variance = ((phi @ fitted.covariance) * phi).sum(-1)
        return TensorDict(
            {
                "success": (z / (1 + math.pi / 8 * variance).sqrt()).sigmoid(),
                "return": fitted.middle + fitted.unit * _times(phi, fitted.mean),
            },
            shape,
        )

    def labels(self, outcome: Mapping[str, Tensor]) -> Tensor:
        """What an outcome [K, m] is to the model, in [0, 1]: float64 [K, m]."""
        if self._labels == "success":
            return outcome["success"]
        worst = torch.minimum(self._worst, outcome["return"].amin(1, keepdim=True))
        return (outcome["return"] > worst + EQUAL * (1 + worst.abs())).double()

    def state_dict(self) -> dict[str, Any]:
        """The rows, and the worst return."""
        return {"batches": [dict(batch) for batch in self._batches], "worst": self._worst}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with them."""
        self._batches = [dict(batch) for batch in state["batches"]]
        self._worst, self._fitted = state["worst"], None

    def _fit(self) -> _Fitted:
        entries = {
            name: torch.cat([batch[name] for batch in self._batches], 1)
            for name in ("features", *self.reads)
        }
        ages = torch.cat(
            [
                torch.full_like(batch["return"], (len(self._batches) - number) / self._half_life)
                for number, batch in enumerate(self._batches, 1)
            ],
            1,
        )
        weights = 0.5**ages
        share = weights / weights.sum(1, keepdim=True)
        middle = (share * entries["return"]).sum(1, keepdim=True)
        unit = (share * (entries["return"] - middle).square()).sum(1, keepdim=True).sqrt()
        unit = unit.where(unit > EQUAL * (1 + middle.abs()), 1.0)  # returns that are all alike
        phi = torch.cat([-ages.unsqueeze(-1), entries["features"]], -1)
        returns = (entries["return"] - middle) / unit
        return _Fitted(
            *logistic_ridge(phi, self.labels(entries), weights, self._ridge),
            middle,
            unit,
            linear_ridge(phi, returns, weights, self._ridge),
        )


class _Fitted(NamedTuple):
    """Regressions on features and age, and the mean and deviation of returns [K, 1]."""

    beta: Tensor
    covariance: Tensor
    middle: Tensor
    unit: Tensor
    mean: Tensor


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)

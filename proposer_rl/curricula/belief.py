"""A belief of what a student reaches on any level, which is carried from batch to batch.

The log odds of success on a level with inputs x in [-1, 1]^D are

    z = beta . phi(x) + u_i,      phi(x) = (1, 0, x, x squared, waves(x)),

with random Fourier features ``waves`` of several lengths (Rahimi and Recht 2007, "Random Features
for Large-Scale Kernel Machines", NeurIPS), and for levels that come back one by one, such as the
items of a data set, what is item i's own, u_i. Both have normal distributions. A batch moves them
to the maximum of their posterior, by Newton's method, with the curvature there as the new precision
(Laplace's approximation, one batch after another: Spiegelhalter and Lauritzen 1990, "Sequential
updating of conditional probabilities on directed graphical structures", Networks 20). Its cost is
linear in the levels of the batch, and nothing is kept of earlier ones.

The student moves. At every batch, with lambda = 2 ** (-1 / half_life), what was known fades towards
the prior, precision P and P beta alike:

    P <- lambda P + (1 - lambda) P_0,      P beta <- lambda P beta,

so that a level that is ``age`` batches old has the weight 2 ** (-age / half_life). The second
column is minus a level's age in half-lives, 0 now: a trend. Growing older by a batch is a linear
map A of the columns, so that first beta <- A^-T beta and P <- A P A^T.

The expectation of success is that of MacKay 1992, "The evidence framework applied to classification
networks" (Neural Computation 4): with s^2 the variance of z,

    p = 1 / (1 + exp(-z / sqrt(1 + pi s^2 / 8))).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

WAVES = 64  # random Fourier features
LENGTHS = 0.3, 1.5  # of the waves, in units of the root of D, on a logarithmic scale
ROUGHNESS = 2.0  # prior variance of the log odds that the waves add
OWN = 1.0  # prior variance of the log odds that are an item's own
WIDEST = 24  # inputs; more are projected to as many
STEPS, CLOSE = 12, 1e-4  # of Newton's method, and the change of log odds at which it ends
LEAP = 3.0  # of log odds in one of its steps, at most
SURE = 1e-3  # least curvature that a level adds, p (1 - p)


class Belief:
    """Believes how likely a student succeeds on levels.

    Args:
        inputs: numbers D that are known of a level.
        items: number N of levels that come back, each with a memory of its own; 0 for none.
        half_life: batches after which a level counts half.
        ridge: prior precision of coefficients.
    """

    def __init__(
        self, inputs: int, items: int = 0, *, half_life: float = 12.0, ridge: float = 0.3
    ) -> None:
        generator = torch.Generator().manual_seed(0)

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        self._half_life = half_life
        self._project = None
        if inputs > WIDEST:
            self._project, inputs = normal(inputs, WIDEST) / math.sqrt(inputs), WIDEST
        low, high = map(math.log, LENGTHS)
        shares = torch.rand(2, WAVES, generator=generator, dtype=torch.float64)
        lengths = (low + (high - low) * shares[0]).exp() * math.sqrt(max(inputs, 1))
        self._frequencies, self._phases = normal(inputs, WAVES) / lengths, 2 * math.pi * shares[1]
        self._height = math.sqrt(2 * ROUGHNESS * ridge / WAVES)
        size = 2 + 2 * inputs + WAVES
        self._prior = ridge * torch.eye(size, dtype=torch.float64)
        self._mean = torch.zeros(size, dtype=torch.float64)
        self._precision = self._prior
        self._own = torch.zeros(items, dtype=torch.float64)
        self._known = torch.full_like(self._own, 1 / OWN)  # the precision of that
        self._covariance: Tensor | None = None

    def grow_older(self, batches: float = 1.0) -> None:
        """Lets batches pass, or a part of one."""
        age = batches / self._half_life
        old, new = 0.5**age, 1 - 0.5**age
        aged, back = torch.eye(len(self._prior), dtype=torch.float64).repeat(2, 1, 1)
        aged[1, 0], back[0, 1] = -age, age
        precision = aged @ self._precision @ aged.mT
        self._precision = old * precision + new * self._prior
        self._mean = torch.linalg.solve(self._precision, old * (precision @ (back @ self._mean)))
        weighed = old * self._known * self._own
        self._known = old * self._known + new / OWN
        self._own = weighed / self._known
        self._covariance = None

    def observe(self, inputs: Tensor, labels: Tensor, items: Tensor | None = None) -> None:
        """Learns from levels that the student was trained on.

        Args:
            inputs: float64 [n, D].
            labels: successes, or shares of them, in [0, 1]: float64 [n].
            items: which of those that come back they are, int64 [n]; None where none do.
        """
        phi, prior, precision = self._columns(inputs), self._mean, self._precision
        own = torch.zeros_like(labels) if items is None else self._own[items]
        z, mean = phi @ prior, prior
        for _ in range(STEPS):
            p = (z + own).sigmoid()
            slope = phi.mT @ (p - labels) + precision @ (mean - prior)
            step = torch.linalg.solve(precision + _curvature(phi, p), slope)
            moved = phi @ step
            size = moved.abs().max()
            part = LEAP / size.clamp(min=LEAP)
            mean, z = mean - part * step, z - part * moved
            if float(size) < CLOSE:
                break
        self._mean, self._covariance = mean, None
        self._precision = precision + _curvature(phi, (z + own).sigmoid())
        if items is not None:
            self._observe_items(items, z, labels)

    def predict(self, inputs: Tensor, items: Tensor | None = None) -> Tensor:
        """Returns the probability of success on levels, float64 [n].

        Args:
            inputs: as of :meth:`observe`.
            items: likewise.
        """
        if self._covariance is None:
            self._covariance = torch.linalg.inv(self._precision)
        phi = self._columns(inputs)
        z, variance = phi @ self._mean, ((phi @ self._covariance) * phi).sum(-1)
        if items is not None:
            z, variance = z + self._own[items], variance + 1 / self._known[items]
        return (z / (1 + math.pi / 8 * variance).sqrt()).sigmoid()

    def state_dict(self) -> dict[str, Any]:
        """Returns means and precisions."""
        return {name: getattr(self, f"_{name}") for name in ("mean", "precision", "own", "known")}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Puts back what :meth:`state_dict` returned."""
        for name, value in state.items():
            setattr(self, f"_{name}", value)
        self._covariance = None

    def _observe_items(self, items: Tensor, z: Tensor, labels: Tensor) -> None:
        """Moves what is the items' own, given what the inputs say of them, z [n]."""
        prior, own, bend = self._own, self._own, self._known
        for _ in range(STEPS):
            p = (z + own[items]).sigmoid()
            slope = (self._known * (own - prior)).scatter_add(0, items, p - labels)
            bend = self._known.scatter_add(0, items, (p * (1 - p)).clamp(min=SURE))
            step = (slope / bend).clamp(-LEAP, LEAP)
            own = own - step
            if float(step.abs().max()) < CLOSE:
                break
        self._own, self._known = own, bend

    def _columns(self, inputs: Tensor) -> Tensor:
        """Returns the columns of inputs [n, D]: [n, F]."""
        x = inputs if self._project is None else inputs @ self._project
        waves = self._height * (x @ self._frequencies + self._phases).cos()
        one = torch.ones_like(waves[..., :1])
        return torch.cat([one, torch.zeros_like(one), x, x.square(), waves], -1)


def _curvature(phi: Tensor, p: Tensor) -> Tensor:
    return phi.mT @ (phi * (p * (1 - p)).clamp(min=SURE).unsqueeze(-1))

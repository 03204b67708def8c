"""A belief of what a student reaches on any level, which is carried from batch to batch.

The log odds of success on a level with inputs x in [-1, 1]^D are

    z = beta . phi(x) + u_i,      phi(x) = (1, 0, x, x squared, waves(x)),

with random Fourier features ``waves`` of several lengths (Rahimi and Recht 2007, "Random Features
for Large-Scale Kernel Machines", NeurIPS), and for levels that come back one by one, such as the
items of a data set, what is item i's own, u_i. Both have normal distributions. A batch moves them
to the maximum of their posterior, by Newton's method, with the curvature there as the new precision
(Laplace's approximation, one batch after another: Spiegelhalter and Lauritzen 1990, "Sequential
updating of conditional probabilities on directed graphical structures", Networks 20). A group of G
episodes counts as G. Its cost is linear in the levels of the batch, and nothing is kept of earlier
ones.

Both are moved together: with v the variance of u_i, w = G p (1 - p) and g = G (p - label), u_i is
eliminated from Newton's equations, which leaves the weight w / (1 + v w) for beta and the slope
g - w (v g + u_i - before) / (1 + v w), so that many answers to one item say little of the others.

The student moves. At every batch, with lambda = 2 ** (-1 / half_life), what was known fades towards
the prior, precision P and P beta alike:

    P <- lambda P + (1 - lambda) P_0,      P beta <- lambda P beta,

so that a level that is ``age`` batches old has the weight 2 ** (-age / half_life). The second
column is minus a level's age in half-lives, 0 now: a trend. Growing older by a batch is a linear
map A of the columns, so that first beta <- A^-T beta and P <- A P A^T.

What is an item's own goes back to what is expected of it, the log odds of a pass rate or 0, with a
half-life LASTING times as long, and its variance to V, that among items:

    u <- e + mu (u - e),      v <- V + mu^2 (v - V),      mu = 2 ** (-1 / (LASTING half_life)),

and V moves by a step of expectation-maximization at every batch, towards the mean of
(u - e)^2 + v of its items.

The expectation of success is that of MacKay 1992, "The evidence framework applied to classification
networks" (Neural Computation 4): with s^2 the variance of z,

    p = 1 / (1 + exp(-z / sqrt(1 + pi s^2 / 8))).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor

WAVES = 64  # random Fourier features
LENGTHS = 0.3, 1.5  # of the waves, in units of the root of D, on a logarithmic scale
ROUGHNESS = 2.0  # prior variance of the log odds that the waves add
OWN = 1.0  # variance at first of the log odds that are an item's own
LASTING = 16.0  # half-lives of these, in that of the coefficients
STEADY = 256.0  # items that the variance is the mean of
WIDEST = 24  # inputs; more are projected to as many
STEPS, CLOSE = 12, 1e-4  # of Newton's method, and the change of log odds at which it ends
LEAP = 3.0  # of log odds in one of its steps, at most
AT_ONCE = 1024  # levels that are predicted together: what fits a cache takes a third of the time
SURE = 1e-3  # least curvature that an episode adds, p (1 - p)
REMEMBERED = "mean", "precision", "own", "seen", "apart"


class Belief:
    """Believes how likely a student succeeds on levels.

    Args:
        inputs: numbers D that are known of a level.
        items: number N of levels that come back, each with a memory of its own; 0 for none.
        expected: log odds of success that are an item's own before anything is seen, float64 [N];
            None for 0.
        half_life: batches after which a level counts half.
        ridge: prior precision of coefficients.
    """

    def __init__(
        self,
        inputs: int,
        items: int = 0,
        *,
        expected: Tensor | None = None,
        half_life: float = 12.0,
        ridge: float = 0.3,
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
        self._apart = torch.tensor(OWN, dtype=torch.float64)  # the variance among items
        self._expected = torch.zeros(items, dtype=torch.float64) if expected is None else expected
        self._own = self._expected
        self._seen = torch.zeros_like(self._own)  # the precision of what was seen of each
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
        left = 0.5 ** (age / LASTING)
        self._own = self._expected + left * (self._own - self._expected)
        known = left**2 * self._apart * self._seen / (1 + self._apart * self._seen)
        self._seen = known / (1 - known) / self._apart
        self._covariance = None

    def observe(
        self,
        inputs: Tensor,
        labels: Tensor,
        items: Tensor | None = None,
        counts: Tensor | None = None,
    ) -> None:
        """Learns from levels that the student was trained on.

        Args:
            inputs: float64 [n, D].
            labels: successes, or shares of them, in [0, 1]: float64 [n].
            items: which of those that come back they are, int64 [n]; None where none do.
            counts: episodes that each label is the mean of, float64 [n]; None for one.
        """
        counts = torch.ones_like(labels) if counts is None else counts
        if items is None:
            own = doubt = torch.zeros_like(labels)
        else:
            items, row = items.unique(return_inverse=True)
            none = torch.zeros(len(items), dtype=torch.float64)
            won, counts = (none.index_add(0, row, one) for one in (counts * labels, counts))
            labels, inputs = (
                won / counts,
                inputs.new_empty(len(items), inputs.shape[1]).index_copy(0, row, inputs),
            )
            own, doubt = self._own[items], self._doubt(items)
        phi, prior, precision = self._columns(inputs), self._mean, self._precision
        z, mean, u = phi @ prior, prior, own
        for _ in range(STEPS):
            p = (z + u).sigmoid()
            pull, bend = counts * (p - labels), counts * _bend(p)
            free = 1 + bend * doubt
            rest = pull - bend * (doubt * pull + (u - own)) / free
            slope = phi.mT @ rest + precision @ (mean - prior)
            step = torch.linalg.solve(precision + _curvature(phi, bend / free), slope)
            moved = phi @ step
            shift = (doubt * (pull - bend * moved) + (u - own)) / free
            size = torch.maximum(moved.abs().max(), shift.abs().max())
            part = LEAP / size.clamp(min=LEAP)
            mean, z, u = mean - part * step, z - part * moved, u - part * shift
            if float(size) < CLOSE:
                break
        bend = counts * _bend((z + u).sigmoid())
        self._mean, self._covariance = mean, None
        self._precision = precision + _curvature(phi, bend / (1 + bend * doubt))
        if items is not None:
            self._own = self._own.index_copy(0, items, u)
            # Where all answers are alike, the curvature at the maximum says far too little.
            share = (counts * labels + 0.5) / (counts + 1)
            seen = torch.maximum(bend, counts * _bend(share))
            self._seen = self._seen.index_add(0, items, seen)
            square = (u - self._expected[items]).square() + self._doubt(items)
            moved = (square - self._apart).sum() / (STEADY + len(items))  # a step of EM
            self._apart = self._apart + moved

    def predict(self, inputs: Tensor, items: Tensor | None = None) -> Tensor:
        """Returns the probability of success on levels, float64 [n].

        Args:
            inputs: as of :meth:`observe`.
            items: likewise.
        """
        if self._covariance is None:
            self._covariance = torch.linalg.inv(self._precision)
        z, variance = inputs.new_empty(2, len(inputs))
        for start in range(0, len(inputs), AT_ONCE):
            some = slice(start, start + AT_ONCE)
            phi = self._columns(inputs[some])
            z[some] = phi @ self._mean
            variance[some] = (phi @ self._covariance).mul_(phi).sum(-1)
        if items is not None:
            z, variance = z + self._own[items], variance + self._doubt(items)
        return (z / (1 + math.pi / 8 * variance).sqrt()).sigmoid()

    def draw(self, inputs: Tensor, items: Tensor, generator: torch.Generator) -> Tensor:
        """Draws a probability of success on each level from the posterior, float64 [n].

        Coefficients are drawn once, what is the items' own for each.

        Args:
            inputs: as of :meth:`observe`.
            items: likewise.
            generator: of the CPU.
        """
        normal = partial(torch.randn, generator=generator, dtype=torch.float64)
        factor = torch.linalg.cholesky(self._precision).mT
        noise = torch.linalg.solve_triangular(factor, normal(len(factor), 1), upper=True)
        mean = self._mean + noise[:, 0]
        own = self._own[items] + self._doubt(items).sqrt() * normal(len(items))
        return (self._columns(inputs) @ mean + own).sigmoid()

    def state_dict(self) -> dict[str, Any]:
        """Returns means, precisions and variances."""
        return {name: getattr(self, f"_{name}") for name in REMEMBERED}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Puts back what :meth:`state_dict` returned."""
        for name in REMEMBERED:
            setattr(self, f"_{name}", state[name])
        self._covariance = None

    def _doubt(self, items: Tensor) -> Tensor:
        """Returns the variances of what is items' own, float64 [n]."""
        return self._apart / (1 + self._apart * self._seen[items])

    def _columns(self, inputs: Tensor) -> Tensor:
        """Returns the columns of inputs [n, D]: [n, F]."""
        x = inputs if self._project is None else inputs @ self._project
        size = x.shape[1]
        phi = x.new_empty(len(x), len(self._mean))
        phi[:, 0], phi[:, 1] = 1, 0
        phi[:, 2 : 2 + size] = x
        torch.square(x, out=phi[:, 2 + size : 2 + 2 * size])
        waves = (x @ self._frequencies).add_(self._phases).cos_()
        torch.mul(waves, self._height, out=phi[:, 2 + 2 * size :])
        return phi


def _bend(p: Tensor) -> Tensor:
    return (p * (1 - p)).clamp(min=SURE)


def _curvature(phi: Tensor, bend: Tensor) -> Tensor:
    return phi.mT @ (phi * bend.unsqueeze(-1))

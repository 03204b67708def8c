"""What students would reach on any level: a Bayesian regression that is carried from batch to batch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

COLUMNS = 64  # random Fourier features
SCALES = 0.3, 1.5  # shortest and longest length of these, in units of the root of D
ROUGHNESS = 2.0  # prior variance of log odds that they add
STEPS, CLOSE = 12, 1e-6  # of Newton's method
OWN = 1.0  # prior variance of what is an item's own, in log odds


class Belief:
    """Beliefs of K students' success on levels."""

    def __init__(
        self,
        students: int,
        inputs: int,
        items: int | None,
        *,
        half_life: float = 12.0,
        ridge: float = 0.3,
    ) -> None:
        generator = torch.Generator().manual_seed(0)
        low, high = (math.log(scale) for scale in SCALES)
        lengths = torch.rand(COLUMNS, generator=generator, dtype=torch.float64)
        lengths = (low + (high - low) * lengths).exp() * math.sqrt(max(inputs, 1))
        self._omega = torch.randn(inputs, COLUMNS, generator=generator, dtype=torch.float64)
        self._omega /= lengths
        self._phase = 2 * math.pi * torch.rand(COLUMNS, generator=generator, dtype=torch.float64)
        self._height = math.sqrt(2 * ROUGHNESS * ridge / COLUMNS)
        self._keep, self._ridge = 0.5 ** (1 / half_life), ridge
        size = 2 + 2 * inputs + COLUMNS
        self._prior = ridge * torch.eye(size, dtype=torch.float64)
        self.mean = torch.zeros(students, size, dtype=torch.float64)
        self.precision = self._prior.repeat(students, 1, 1)
        self._shift = torch.eye(size, dtype=torch.float64)  # of the first, by the second
        self._shift[1, 0] = -1 / half_life
        self._back = torch.linalg.inv(self._shift).mT
        self._cov: Tensor | None = None
        self._items = items
        if items:
            self.own = torch.zeros(students, items, dtype=torch.float64)
            self.known = torch.full((students, items), 1 / OWN, dtype=torch.float64)

    def columns(self, inputs: Tensor) -> Tensor:
        """Columns [K, n, F] of inputs float64 [K, n, D]."""
        waves = self._height * (inputs @ self._omega + self._phase).cos()
        one = torch.ones_like(waves[..., :1])
        return torch.cat([one, torch.zeros_like(one), inputs, inputs.square(), waves], -1)

    def grow_older(self) -> None:
        """One batch more has passed."""
        keep, new = self._keep, 1 - self._keep
        mean = keep * (self.precision @ self.mean.unsqueeze(-1))
        self.precision = keep * self.precision + new * self._prior
        self.mean = torch.linalg.solve(self.precision, mean).squeeze(-1)
        self.mean = self.mean @ self._back.mT
        self.precision = self._shift @ self.precision @ self._shift.mT
        if self._items:
            weight = self.known * self.own * keep
            self.known = keep * self.known + new / OWN
            self.own = weight / self.known
        self._cov = None

    def observe(self, inputs: Tensor, labels: Tensor, items: Tensor | None) -> None:
        """Learns from labels [K, n] in [0, 1] at inputs [K, n, D]."""
        phi = self.columns(inputs)
        offset = self.own.gather(1, items) if self._items else torch.zeros_like(labels)
        prior, precision = self.mean, self.precision
        beta = prior.clone()
        for _ in range(STEPS):
            p = ((phi @ beta.unsqueeze(-1)).squeeze(-1) + offset).sigmoid()
            weight = (p * (1 - p)).clamp(min=1e-3)
            curvature = phi.mT @ (phi * weight.unsqueeze(-1)) + precision
            slope = (phi.mT @ (p - labels).unsqueeze(-1)).squeeze(-1)
            slope = slope + (precision @ (beta - prior).unsqueeze(-1)).squeeze(-1)
            step = torch.linalg.solve(curvature, slope)
            size = (phi @ step.unsqueeze(-1)).abs().amax(1)  # no log odds moves by more than 3
            beta = beta - step * (3 / size.clamp(min=3))
            if float(step.abs().max()) < CLOSE:
                break
        p = ((phi @ beta.unsqueeze(-1)).squeeze(-1) + offset).sigmoid()
        weight = (p * (1 - p)).clamp(min=1e-3)
        self.mean = beta
        self.precision = phi.mT @ (phi * weight.unsqueeze(-1)) + precision
        self._cov = None
        if self._items:
            z = (phi @ beta.unsqueeze(-1)).squeeze(-1)
            start, known = self.own.clone(), self.known
            own = start.clone()
            for _ in range(4):
                p = (z + own.gather(1, items)).sigmoid()
                slope = torch.zeros_like(own).scatter_add(1, items, p - labels)
                bend = torch.zeros_like(own).scatter_add(1, items, p * (1 - p))
                own = own - (slope + known * (own - start)) / (bend + known)
            self.own, self.known = own, known + bend

    def predict(self, inputs: Tensor, items: Tensor | None, k: int | None = None) -> Tensor:
        """Probability of success [K, n], or of student k's [n]."""
        if self._cov is None:
            self._cov = torch.linalg.inv(self.precision)
        mean, cov = (self.mean, self._cov) if k is None else (self.mean[k], self._cov[k])
        phi = self.columns(inputs)
        z = (phi @ mean.unsqueeze(-1)).squeeze(-1)
        variance = ((phi @ cov) * phi).sum(-1)
        if self._items:
            own, known = (self.own, self.known) if k is None else (self.own[k], self.known[k])
            z = z + own.gather(-1, items)
            variance = variance + 1 / known.gather(-1, items)
        return (z / (1 + math.pi / 8 * variance).sqrt()).sigmoid()

    def state_dict(self) -> dict[str, Any]:
        own = {"own": self.own, "known": self.known} if self._items else {}
        return {"mean": self.mean, "precision": self.precision, **own}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        for name, value in state.items():
            setattr(self, name, value)
        self._cov = None

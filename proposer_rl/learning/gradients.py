"""Clipping the gradients of K replicas, each by its own norm."""

from __future__ import annotations

import torch
from torch import Tensor, nn


def clip_gradients_(parameters: list[nn.Parameter], max_norm: float, copies: int | None) -> Tensor:
    """Scale gradients (in place) so that no replica's norm exceeds ``max_norm``.

    Args:
        parameters: with replicas, each [K, ...].
        max_norm: largest norm over all parameters of one replica.
        copies: K, or None if the parameters belong to a single network.

    Returns:
        The norms before clipping, [K] or [].
    """
    if copies is None:
        return nn.utils.clip_grad_norm_(parameters, max_norm)
    gradients = [p.grad for p in parameters if p.grad is not None]
    # Slice by slice, since a norm over a row of several is rounded otherwise than over one alone.
    slices = [gradient[k] for k in range(copies) for gradient in gradients]
    norms = torch.stack(torch._foreach_norm(slices)).view(copies, len(gradients))
    norm = norms.square().sum(1).sqrt()  # [K]
    scale = (max_norm / (norm + 1e-6)).clamp(max=1.0)
    for gradient in gradients:
        gradient.mul_(scale.view(-1, *[1] * (gradient.ndim - 1)))
    return norm

"""Adam for K copies of a network, in which no copy's step depends on where the copy stands."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

LANES = 16
"""Floats in the widest vector register of a CPU."""


class CopiesAdam:
    """Torch's fused Adam over parameters whose first dimension are the copies.

    The fused kernel takes whole registers of a parameter at a time and what is left over at its
    end one by one, which rounds otherwise. So that a copy's numbers are the same whether it is
    alone, in the middle or the last, every copy's part of a parameter is put at the start of a
    register of its own: parameters of another size move into memory padded with zeros.

    Args:
        parameters: contiguous; with copies each [K, ...]. Where one is padded, its data become a
            view of the padded memory, so later changes of them must be made in place.
        copies: K, or None for a single network.
        learning_rate, eps: as Adam's.
    """

    def __init__(
        self,
        parameters: Sequence[nn.Parameter],
        copies: int | None,
        learning_rate: float,
        eps: float,
    ) -> None:
        self._parameters = list(parameters)
        self._whole = [_in_registers(parameter, copies or 1) for parameter in self._parameters]
        self._adam = torch.optim.Adam(
            self._whole,
            lr=learning_rate,
            eps=eps,
            fused=True,
            capturable=self._parameters[0].is_cuda,
        )
        # Adam makes its state at the first step; made at once, a snapshot is always complete.
        for whole in self._whole:
            self._adam.state[whole] = {
                "step": torch.zeros((), device=whole.device),
                "exp_avg": torch.zeros_like(whole),
                "exp_avg_sq": torch.zeros_like(whole),
            }

    def state(self, index: int) -> dict[str, Tensor]:
        """Adam's state of the parameter with this index.

        Returns:
            ``step`` [], and ``exp_avg`` and ``exp_avg_sq`` as views of the parameter's shape.
        """
        parameter, whole = self._parameters[index], self._whole[index]
        state = self._adam.state[whole]
        moments = {key: _part(state[key], parameter.shape) for key in ("exp_avg", "exp_avg_sq")}
        return {"step": state["step"], **moments}

    def zero_grad(self) -> None:
        """Forget the parameters' gradients."""
        for parameter in self._parameters:
            parameter.grad = None

    def step(self) -> None:
        """Move the parameters by their gradients."""
        for parameter, whole in zip(self._parameters, self._whole, strict=True):
            if whole is parameter:
                continue
            if parameter.grad is None:
                whole.grad = None
                continue
            if whole.grad is None:
                whole.grad = torch.zeros_like(whole)
            _part(whole.grad, parameter.shape).copy_(parameter.grad)
        self._adam.step()


def _in_registers(parameter: nn.Parameter, rows: int) -> nn.Parameter:
    """The parameter, or the padded memory [rows, N] that it has been moved to."""
    size = parameter.numel() // rows
    padding = -size % LANES
    if padding == 0:
        return parameter
    whole = nn.functional.pad(parameter.detach().reshape(rows, size), (0, padding))
    parameter.data = _part(whole, parameter.shape)
    return nn.Parameter(whole)


def _part(whole: Tensor, shape: torch.Size) -> Tensor:
    """What of padded memory belongs to a parameter, as a view of the parameter's shape."""
    if whole.shape == shape:
        return whole
    size = shape.numel() // len(whole)
    return whole.detach()[:, :size].view(shape)

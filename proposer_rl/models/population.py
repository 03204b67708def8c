"""K copies of one network as a single module, their parameters stacked along a first dimension."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call, vmap


class Population(nn.Module):
    """K independent copies of a network, called and trained as one module.

    Inputs and outputs carry the copies as their first dimension, [K, ...], and copy ``k`` sees only
    slice ``k``. The sum over copies of each copy's loss therefore gives every copy exactly the
    gradient that it would have alone.

    Args:
        make: builds one network, without buffers; called once per copy, in order.
        copies: number of copies K.
        precision: ``"fp32"``, or ``"bf16"`` for autocast of the networks' arithmetic (parameters,
            gradients and outputs stay float32).

    Raises:
        ValueError: for fewer than one copy, an unknown precision, or a network with buffers.
    """

    def __init__(self, make: Callable[[], nn.Module], copies: int, precision: str = "fp32") -> None:
        super().__init__()
        if copies < 1:
            raise ValueError(f"copies must be at least 1, got {copies}")
        if precision not in ("fp32", "bf16"):
            raise ValueError(f"precision must be 'fp32' or 'bf16', got {precision!r}")
        members = [make() for _ in range(copies)]
        if next(members[0].buffers(), None) is not None:
            raise ValueError("a Population's network must not have buffers")
        self.copies = copies
        self.precision = precision
        self.names = [name for name, _ in members[0].named_parameters()]
        self.stacked = nn.ParameterList(
            nn.Parameter(torch.stack([p.detach() for p in parameters]))
            for parameters in zip(*(member.parameters() for member in members), strict=True)
        )
        # In a tuple, so that nn.Module does not register it: it lends its structure, no numbers.
        self._template = (members[0].to("meta"),)

    def forward(self, *inputs: Tensor) -> Any:
        """Apply copy ``k`` to slice ``k`` of each input [K, ...]; outputs are stacked, [K, ...]."""
        parameters = list(self.stacked)
        apply = _apply_batched if parameters[0].is_cuda else _apply_in_turn
        with _autocast(self.precision, parameters[0].device):
            outputs = apply(self._template[0], self.names, parameters, inputs)
        return _map(Tensor.float, outputs)


def _apply_in_turn(
    network: nn.Module, names: Sequence[str], stacked: Sequence[Tensor], inputs: Sequence[Tensor]
) -> Any:
    """One copy after the other: the fastest way on a CPU, and the reference for every other way."""
    # unbind, not indexing: its backward is one stack, not K additions into full-sized zeros.
    members = zip(*(parameter.unbind() for parameter in stacked), strict=True)
    outputs = [
        functional_call(network, dict(zip(names, member, strict=True)), tuple(x[k] for x in inputs))
        for k, member in enumerate(members)
    ]
    if isinstance(outputs[0], Tensor):
        return torch.stack(outputs)
    return tuple(torch.stack(slices) for slices in zip(*outputs, strict=True))


def _apply_batched(
    network: nn.Module, names: Sequence[str], stacked: Sequence[Tensor], inputs: Sequence[Tensor]
) -> Any:
    """All copies in each kernel (convolutions become grouped ones): few launches, for a GPU."""

    def one(member: tuple[Tensor, ...], *slices: Tensor) -> Any:
        return functional_call(network, dict(zip(names, member, strict=True)), slices)

    return vmap(one)(tuple(stacked), *inputs)


def _autocast(precision: str, device: torch.device) -> AbstractContextManager[Any]:
    if precision == "fp32":
        return nullcontext()
    return torch.autocast(device.type, torch.bfloat16)


def _map(function: Callable[[Tensor], Tensor], outputs: Any) -> Any:
    if isinstance(outputs, Tensor):
        return function(outputs)
    return tuple(function(output) for output in outputs)

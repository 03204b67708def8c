"""K replicas of one network as a single module, whose parameters are stacked, [K, ...]."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from proposer_rl.models.convolution import Conv3x3
from proposer_rl.models.stacked import Call, apply_alone, apply_batched, apply_on_cores


class Population(nn.Module):
    """K independent replicas of a network, called and trained as one module.

    Inputs and outputs carry the replicas as their first dimension, [K, ...], and replica ``k`` sees
    only slice ``k``. The sum over replicas of each one's loss therefore gives every replica exactly
    the gradient that it would have alone.

    Args:
        make: builds one network, without buffers, that maps tensors to one tensor or a tuple of
            them; called once per replica, in order.
        copies: number of replicas K.
        precision: ``"fp32"``, or ``"bf16"`` for autocast of the networks' arithmetic (parameters,
            gradients and outputs stay float32).
        cores: replicas that are computed at once on a CPU, each by one thread; None for as many as
            the process may use. The numbers are those of one thread whatever the cores.
        batched: whether all replicas are computed at once, in each operation; None for doing so on
            a GPU but not on a CPU, where only very small networks are faster that way.

    Raises:
        ValueError: for fewer than one replica or core, another precision, or a network with
            buffers.

    Example:
        >>> population = Population(lambda: nn.Linear(3, 2), copies=5)
        >>> population(torch.ones(5, 10, 3)).shape
        torch.Size([5, 10, 2])
    """

    def __init__(
        self,
        make: Callable[[], nn.Module],
        copies: int,
        precision: str = "fp32",
        cores: int | None = None,
        batched: bool | None = None,
    ) -> None:
        super().__init__()
        cores = available_cores() if cores is None else cores
        if min(copies, cores) < 1:
            raise ValueError(f"copies and cores must be at least 1, got {copies} and {cores}")
        if precision not in ("fp32", "bf16"):
            raise ValueError(f"precision must be 'fp32' or 'bf16', got {precision!r}")
        members = [make() for _ in range(copies)]
        if next(members[0].buffers(), None) is not None:
            raise ValueError("a Population's network must not have buffers")
        self.copies = copies
        self.precision = precision
        self.cores = cores
        self.batched = batched
        self.names = [name for name, _ in members[0].named_parameters()]
        self.stacked = nn.ParameterList(
            nn.Parameter(torch.stack([p.detach() for p in parameters]))
            for parameters in zip(*(member.parameters() for member in members), strict=True)
        )
        # In a tuple, so that nn.Module does not register it: it lends its structure, no numbers.
        self._template = (members[0].to("meta"),)

    def prefer_products(self) -> None:
        """Let 3x3 convolutions of several replicas be products, which a compiler fuses."""
        for layer in self._template[0].modules():
            if isinstance(layer, Conv3x3):
                layer.as_product = self.copies > 1

    def forward(self, *inputs: Tensor) -> Any:
        """Apply replica ``k`` to slice ``k`` of each input [K, ...]; outputs are [K, ...], too."""
        call = Call(self._template[0], self.names, self.precision)
        stacked = list(self.stacked)
        batched = stacked[0].device.type != "cpu" if self.batched is None else self.batched
        if self.copies == 1:
            outputs = apply_alone(call, stacked, inputs)
        elif batched:
            outputs = apply_batched(call, stacked, inputs)
        else:
            outputs = apply_on_cores(call, stacked, inputs, self.cores)
        return outputs[0] if len(outputs) == 1 else outputs


def available_cores() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def at_hand(tensor: Tensor) -> bool:
    """Whether a tensor's numbers can be read without waiting for a device."""
    return tensor.device.type == "cpu"


def use_device(device: torch.device) -> None:
    """Make a GPU the current one, whose fp32 products round their factors to TF32.

    What it computes is the same every time: sums are not taken in the order in which threads come
    to be done. Without a GPU nothing is changed.
    """
    if device.type == "cuda":
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        # It warns of running sums, which are taken in disorder along a single long row alone.
        warnings.filterwarnings("ignore", message="cumsum_cuda_kernel does not have")
        torch.use_deterministic_algorithms(True, warn_only=True)
        torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
        if device.index is not None:  # Ray's workers see none but their own
            torch.cuda.set_device(device)
        torch.set_float32_matmul_precision("high")

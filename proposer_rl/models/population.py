"""K copies of one network as a single module, their parameters stacked along a first dimension."""

from __future__ import annotations

import copy
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call, vmap


class Population(nn.Module):
    """K independent copies of a network, called and trained as one module.

    Inputs and outputs carry the copies as their first dimension, [K, ...], and copy ``k`` sees only
    slice ``k``. The sum over copies of each copy's loss therefore gives every copy exactly the
    gradient that it would have alone.

    Args:
        make: builds one network, without buffers, that maps tensors to one tensor or a tuple of
            them; called once per copy, in order.
        copies: number of copies K.
        precision: ``"fp32"``, or ``"bf16"`` for autocast of the networks' arithmetic (parameters,
            gradients and outputs stay float32).
        cores: copies that are computed at once on a CPU, each by one thread; None for as many as
            the process may use. The numbers are those of one thread whatever the cores.

    Raises:
        ValueError: for fewer than one copy or core, an unknown precision, or a network with
            buffers.
    """

    def __init__(
        self,
        make: Callable[[], nn.Module],
        copies: int,
        precision: str = "fp32",
        cores: int | None = None,
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
        self.names = [name for name, _ in members[0].named_parameters()]
        self.stacked = nn.ParameterList(
            nn.Parameter(torch.stack([p.detach() for p in parameters]))
            for parameters in zip(*(member.parameters() for member in members), strict=True)
        )
        # In a tuple, so that nn.Module does not register it: it lends its structure, no numbers.
        self._template = (members[0].to("meta"),)

    def forward(self, *inputs: Tensor) -> Any:
        """Apply copy ``k`` to slice ``k`` of each input [K, ...]; outputs are stacked, [K, ...]."""
        stacked = list(self.stacked)
        call = _Call(self._template[0], self.names, self.precision)
        if stacked[0].is_cuda:
            outputs = apply_batched(call, stacked, inputs)
        elif self.copies > 1:
            outputs = apply_on_cores(call, stacked, inputs, self.cores)
        else:
            outputs = apply_in_turn(call, stacked, inputs)
        return outputs[0] if len(outputs) == 1 else outputs


class _Call(NamedTuple):
    """The network with the parameters of one copy: what all the ways below have in common."""

    network: nn.Module
    names: Sequence[str]
    precision: str

    def __call__(self, member: Sequence[Tensor], inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        parameters = dict(zip(self.names, member, strict=True))
        with _autocast(self.precision, member[0].device):
            outputs = functional_call(self.network, parameters, tuple(inputs))
        if isinstance(outputs, Tensor):
            outputs = (outputs,)
        return tuple(output.float() for output in outputs)


def apply_in_turn(
    call: _Call, stacked: Sequence[Tensor], inputs: Sequence[Tensor]
) -> tuple[Tensor, ...]:
    """One copy after the other: the plain way, and the reference for the others."""
    # unbind, not indexing: its backward is one stack, not K additions into full-sized zeros.
    members = zip(*(parameter.unbind() for parameter in stacked), strict=True)
    outputs = [call(member, [x[k] for x in inputs]) for k, member in enumerate(members)]
    return tuple(torch.stack(slices) for slices in zip(*outputs, strict=True))


def apply_batched(
    call: _Call, stacked: Sequence[Tensor], inputs: Sequence[Tensor]
) -> tuple[Tensor, ...]:
    """All copies in each kernel (convolutions become grouped ones): few launches, for a GPU."""

    def one(member: tuple[Tensor, ...], slices: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        return call(member, slices)

    return vmap(one)(tuple(stacked), tuple(inputs))


def apply_on_cores(
    call: _Call, stacked: Sequence[Tensor], inputs: Sequence[Tensor], cores: int
) -> tuple[Tensor, ...]:
    """Each copy on one core: small maps keep a core busy, but not several at once."""
    with_graph = torch.is_grad_enabled()  # unknown inside, where gradients are always off
    return _OnCores.apply(call, _pool(cores), with_graph, len(inputs), *inputs, *stacked)


class _OnCores(torch.autograd.Function):
    """Forward and backward of the copies in threads, each through a graph of its own."""

    @staticmethod
    def forward(
        ctx: Any,
        call: _Call,
        pool: ThreadPoolExecutor,
        with_graph: bool,
        n_inputs: int,
        *tensors: Tensor,
    ) -> tuple[Tensor, ...]:
        def one(k: int) -> tuple[tuple[Tensor, ...], list[Tensor]]:
            leaves = [
                x[k].detach().requires_grad_(with_graph and needs)
                for x, needs in zip(tensors, ctx.needs_input_grad[4:], strict=True)
            ]
            own = call._replace(network=_own_network(call.network))
            with torch.set_grad_enabled(with_graph):
                outputs = own(leaves[n_inputs:], leaves[:n_inputs])
            return outputs, leaves

        results = list(pool.map(one, range(len(tensors[-1]))))
        # The graphs live in ctx, not among its saved tensors: they are made here and freed with it.
        ctx.graphs, ctx.pool = results, pool
        outputs = zip(*(outputs for outputs, _ in results), strict=True)
        return tuple(torch.stack([o.detach() for o in slices]) for slices in outputs)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        needs = ctx.needs_input_grad[4:]

        def one(k: int) -> list[Tensor]:
            outputs, leaves = ctx.graphs[k]
            wanted = [leaf for leaf, need in zip(leaves, needs, strict=True) if need]
            slopes = [g[k] for g in gradients]
            # A parameter that the network does not use has a gradient of zero.
            return list(torch.autograd.grad(outputs, wanted, slopes, materialize_grads=True))

        results = zip(*ctx.pool.map(one, range(len(ctx.graphs))), strict=True)
        stacked = iter([torch.stack(slices) for slices in results])
        ctx.graphs = None
        return None, None, None, None, *(next(stacked) if need else None for need in needs)


def available_cores() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@cache
def _pool(cores: int) -> ThreadPoolExecutor:
    """Threads that each compute on one core."""
    return ThreadPoolExecutor(cores, "copy", initializer=torch.set_num_threads, initargs=(1,))


_networks = threading.local()


def _own_network(network: nn.Module) -> nn.Module:
    """This thread's own copy of a template: functional calls put parameters into it meanwhile."""
    own = getattr(_networks, "of", None)
    if own is None or own[0] is not network:
        own = _networks.of = (network, copy.deepcopy(network))
    return own[1]


def _autocast(precision: str, device: torch.device) -> AbstractContextManager[Any]:
    if precision == "fp32":
        return nullcontext()
    return torch.autocast(device.type, torch.bfloat16)

"""The ways of applying a network whose parameters are stacked: all at once, or each on a core."""

from __future__ import annotations

import copy
import os
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from functools import cache
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call, vmap
from torch.nn.functional import linear


class Call(NamedTuple):
    """The network with the parameters of one replica: what the ways below have in common."""

    network: nn.Module
    names: Sequence[str]
    precision: str

    def __call__(self, member: Sequence[Tensor], inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Apply the network with one replica's parameters to its inputs."""
        parameters = dict(zip(self.names, member, strict=True))
        low, device = self.precision == "bf16", member[0].device.type
        with torch.autocast(device, torch.bfloat16) if low else nullcontext():
            outputs = functional_call(self.network, parameters, tuple(inputs), tie_weights=False)
        if isinstance(outputs, Tensor):
            outputs = (outputs,)
        return tuple(output.float() for output in outputs)


class StackedLinear(nn.Linear):
    """A linear layer whose parameters may be stacked, [K, ...], for inputs [K, *B, features].

    Networks of nothing but such layers say so by a true ``stackable``: all replicas are then
    computed without ``vmap``, which costs as much as the arithmetic of a small network.
    """

    def forward(self, inputs: Tensor) -> Tensor:
        """The layer's outputs, [*B, features] or [K, *B, features]."""
        if self.weight.ndim == 2:
            return linear(inputs, self.weight, self.bias)
        rows = inputs.flatten(1, -2)
        outputs = torch.baddbmm(self.bias.unsqueeze(1), rows, self.weight.mT)
        return outputs.unflatten(1, inputs.shape[1:-1])


def apply_alone(
    call: Call, stacked: Sequence[Tensor], inputs: Sequence[Tensor]
) -> tuple[Tensor, ...]:
    """The only replica, as the network that it is."""
    outputs = call([p.squeeze(0) for p in stacked], [x[0] for x in inputs])
    return tuple(output.unsqueeze(0) for output in outputs)


def apply_batched(
    call: Call, stacked: Sequence[Tensor], inputs: Sequence[Tensor]
) -> tuple[Tensor, ...]:
    """All replicas in each kernel (convolutions become grouped ones): few launches, for a GPU."""
    if getattr(call.network, "stackable", False):
        return call(stacked, inputs)
    return vmap(lambda *member: call(*member))(tuple(stacked), tuple(inputs))


def apply_on_cores(
    call: Call, stacked: Sequence[Tensor], inputs: Sequence[Tensor], cores: int
) -> tuple[Tensor, ...]:
    """Each replica on one core: small maps keep a core busy, but not several at once."""
    with_graph = torch.is_grad_enabled()  # unknown inside, where gradients are always off
    return _OnCores.apply(call, _pool(cores), with_graph, len(inputs), *inputs, *stacked)


class _OnCores(torch.autograd.Function):
    """Forward and backward of the replicas in threads, each through a graph of its own."""

    @staticmethod
    def forward(
        ctx: Any,
        call: Call,
        pool: ThreadPoolExecutor,
        with_graph: bool,
        n_inputs: int,
        *tensors: Tensor,
    ) -> tuple[Tensor, ...]:
        needs = ctx.needs_input_grad[4:]

        def one(k: int) -> tuple[tuple[Tensor, ...], list[Tensor]]:
            leaves = [
                x[k].detach().requires_grad_(with_graph and need)
                for x, need in zip(tensors, needs, strict=True)
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

        def one(k: int) -> tuple[Tensor, ...]:
            outputs, leaves = ctx.graphs[k]
            wanted = [leaf for leaf, need in zip(leaves, needs, strict=True) if need]
            slopes = [g[k] for g in gradients]
            # A parameter that the network does not use has a gradient of zero.
            return torch.autograd.grad(outputs, wanted, slopes, materialize_grads=True)

        results = zip(*ctx.pool.map(one, range(len(ctx.graphs))), strict=True)
        stacked = iter([torch.stack(slices) for slices in results])
        ctx.graphs = None
        return None, None, None, None, *(next(stacked) if need else None for need in needs)


@cache
def _pool(cores: int) -> ThreadPoolExecutor:
    """Threads that each compute on one core."""
    return ThreadPoolExecutor(cores, "replica", initializer=torch.set_num_threads, initargs=(1,))


if hasattr(os, "register_at_fork"):  # not on Windows
    # A forked process inherits the pool, but not its threads.
    os.register_at_fork(after_in_child=_pool.cache_clear)

_networks = threading.local()


def _own_network(network: nn.Module) -> nn.Module:
    """This thread's own copy of a template: functional calls put parameters into it meanwhile."""
    own = getattr(_networks, "of", None)
    if own is None or own[0] is not network:
        own = _networks.of = (network, copy.deepcopy(network))
    return own[1]

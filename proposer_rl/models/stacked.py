"""The ways of applying a network whose parameters are stacked: equal numbers, unequal speed."""

from __future__ import annotations

import copy
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from functools import cache, partial
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.func import functional_call, vmap

from proposer_rl.learning.cuda_graphs import WARM_UPS, Captured, Recorder


class Call(NamedTuple):
    """The network with the parameters of one copy: what all the ways below have in common."""

    network: nn.Module
    names: Sequence[str]
    precision: str

    def __call__(self, member: Sequence[Tensor], inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Apply the network with one copy's parameters to its inputs."""
        parameters = dict(zip(self.names, member, strict=True))
        with _autocast(self.precision, member[0].device):
            outputs = functional_call(self.network, parameters, tuple(inputs))
        if isinstance(outputs, Tensor):
            outputs = (outputs,)
        return tuple(output.float() for output in outputs)


def apply_in_turn(
    call: Call, stacked: Sequence[Tensor], inputs: Sequence[Tensor]
) -> tuple[Tensor, ...]:
    """One copy after the other: the plain way, and the reference for the others."""
    outputs = [call(member, [x[k] for x in inputs]) for k, member in enumerate(_members(stacked))]
    return _stack(outputs)


def _members(stacked: Sequence[Tensor]) -> Iterator[tuple[Tensor, ...]]:
    """The parameters of each copy.

    By unbinding, whose backward pass is one stack; indexing would add into full-sized zeros, K
    times. A view is enough for a single copy, and costs nothing in either pass.
    """
    alone = len(stacked[0]) == 1
    return zip(*((p.squeeze(0),) if alone else p.unbind() for p in stacked), strict=True)


def _stack(outputs: Sequence[tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
    """The copies' outputs, stacked one by one."""
    if len(outputs) == 1:
        return tuple(output.unsqueeze(0) for output in outputs[0])
    return tuple(torch.stack(slices) for slices in zip(*outputs, strict=True))


def apply_batched(
    call: Call, stacked: Sequence[Tensor], inputs: Sequence[Tensor]
) -> tuple[Tensor, ...]:
    """All copies in each kernel (convolutions become grouped ones): few launches, for a GPU."""

    def one(member: tuple[Tensor, ...], slices: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        return call(member, slices)

    return vmap(one)(tuple(stacked), tuple(inputs))


def apply_on_streams(
    call: Call, stacked: Sequence[Tensor], inputs: Sequence[Tensor], streams: int
) -> tuple[Tensor, ...]:
    """The copies side by side on a few streams: a copy's kernels rarely fill a GPU.

    In a recorded function the streams become branches of the graph. The backward pass of an
    operation runs on the stream of its forward pass. On a CPU, where streams mean nothing, it is
    :func:`apply_in_turn`.
    """
    device = stacked[0].device
    module = torch.get_device_module(device)
    current, side = module.current_stream(), _streams(device, streams)
    for stream in side:
        stream.wait_stream(current)
    outputs = []
    for k, member in enumerate(_members(stacked)):
        with module.stream(side[k % streams]):
            outputs.append(call(member, [x[k] for x in inputs]))
    for stream in side:
        current.wait_stream(stream)
    return _stack(outputs)


@cache
def _streams(device: torch.device, count: int) -> list[Any]:
    module = torch.get_device_module(device)
    return [module.Stream() for _ in range(count)]


def apply_on_cores(
    call: Call,
    stacked: Sequence[Tensor],
    inputs: Sequence[Tensor],
    cores: int,
    share: range | None = None,
) -> tuple[Tensor, ...]:
    """Each copy on one core: small maps keep a core busy, but not several at once.

    Of copies outside of the ``share`` outputs and gradients are zeros.
    """
    share = range(len(stacked[0])) if share is None else share
    with_graph = torch.is_grad_enabled()  # unknown inside, where gradients are always off
    return _OnCores.apply(call, _pool(cores), share, with_graph, len(inputs), *inputs, *stacked)


class _OnCores(torch.autograd.Function):
    """Forward and backward of the copies in threads, each through a graph of its own."""

    @staticmethod
    def forward(
        ctx: Any,
        call: Call,
        pool: ThreadPoolExecutor,
        share: range,
        with_graph: bool,
        n_inputs: int,
        *tensors: Tensor,
    ) -> tuple[Tensor, ...]:
        def one(k: int) -> tuple[tuple[Tensor, ...], list[Tensor]]:
            leaves = [
                x[k].detach().requires_grad_(with_graph and needs)
                for x, needs in zip(tensors, ctx.needs_input_grad[5:], strict=True)
            ]
            own = call._replace(network=_own_network(call.network))
            with torch.set_grad_enabled(with_graph):
                outputs = own(leaves[n_inputs:], leaves[:n_inputs])
            return outputs, leaves

        results = list(pool.map(one, share))
        # The graphs live in ctx, not among its saved tensors: they are made here and freed with it.
        ctx.graphs, ctx.pool, ctx.share, ctx.copies = results, pool, share, len(tensors[-1])
        outputs = zip(*(outputs for outputs, _ in results), strict=True)
        return tuple(
            _among_all([o.detach() for o in slices], share, ctx.copies) for slices in outputs
        )

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        needs = ctx.needs_input_grad[5:]

        def one(k: int) -> list[Tensor]:
            outputs, leaves = ctx.graphs[k - ctx.share.start]
            wanted = [leaf for leaf, need in zip(leaves, needs, strict=True) if need]
            slopes = [g[k] for g in gradients]
            # A parameter that the network does not use has a gradient of zero.
            return list(torch.autograd.grad(outputs, wanted, slopes, materialize_grads=True))

        results = zip(*ctx.pool.map(one, ctx.share), strict=True)
        stacked = iter([_among_all(slices, ctx.share, ctx.copies) for slices in results])
        ctx.graphs = None
        return None, None, None, None, None, *(next(stacked) if need else None for need in needs)


def _among_all(slices: Sequence[Tensor], share: range, copies: int) -> Tensor:
    """A share's slices stacked among zeros for the other copies, [K, ...]."""
    rest = torch.zeros_like(slices[0])
    return torch.stack([rest] * share.start + [*slices] + [rest] * (copies - share.stop))


@cache
def _pool(cores: int) -> ThreadPoolExecutor:
    """Threads that each compute on one core."""
    return ThreadPoolExecutor(cores, "copy", initializer=torch.set_num_threads, initargs=(1,))


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


def _autocast(precision: str, device: torch.device) -> AbstractContextManager[Any]:
    if precision == "fp32":
        return nullcontext()
    return torch.autocast(device.type, torch.bfloat16)


Way = Callable[[Call, Sequence[Tensor], Sequence[Tensor]], tuple[Tensor, ...]]

WAYS: dict[str, Way] = {
    "in turn": apply_in_turn,
    "batched": apply_batched,
    "4 streams": partial(apply_on_streams, streams=4),
    "16 streams": partial(apply_on_streams, streams=16),
}


def measure(
    ways: Mapping[str, Way],
    call: Call,
    stacked: Sequence[Tensor],
    inputs: Sequence[Tensor],
    recorder: Recorder | None,
    repeats: int = 5,
) -> dict[str, float]:
    """Seconds of a forward and backward pass of each way, recorded as it will be in training."""
    return {
        name: _seconds(partial(_both_passes, way, call, stacked, inputs), recorder, repeats)
        for name, way in ways.items()
    }


def _both_passes(
    way: Way,
    call: Call,
    stacked: Sequence[Tensor],
    inputs: Sequence[Tensor],
    _: TensorDictBase,
) -> TensorDict:
    with torch.enable_grad():
        loss = torch.stack([output.sum() for output in way(call, stacked, inputs)]).sum()
        torch.autograd.grad(loss, list(stacked), allow_unused=True)
    return TensorDict({"loss": loss.detach()})


def _seconds(
    function: Callable[[TensorDictBase], TensorDictBase], recorder: Recorder | None, repeats: int
) -> float:
    captured, nothing = Captured(function, recorder), TensorDict({})
    for _ in range(WARM_UPS + 1):
        float(captured(nothing)["loss"])  # waits for the device
    start = time.perf_counter()
    for _ in range(repeats):
        last = captured(nothing)
    float(last["loss"])
    return (time.perf_counter() - start) / repeats

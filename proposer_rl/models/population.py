"""K replicas of one network as a single module with stacked parameters, [K, ...].

Also layers that are fast in such a module, and functions that choose processors.
"""

from __future__ import annotations

import copy
import os
import threading
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from functools import cache, partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call, vmap
from torch.nn import functional as F
from torch.nn.grad import conv2d_input

# Where the product below is faster than the library's kernel, measured on a CPU with AMX.
FEW_PIXELS = 25  # pixels at most
MANY_CHANNELS = 64  # at least, in and out


class Population(nn.Module):
    """Calls and trains K independent replicas of a network as one module.

    Inputs and outputs have the replicas as their first dimension, [K, ...], and replica ``k`` sees
    only slice ``k``. So the sum of the losses of all replicas gives each one exactly the gradient
    that it would have alone.

    Args:
        make: builds one network, without buffers, that maps tensors to one tensor or a tuple of
            them; called once per replica, in order.
        copies: number K of replicas.
        precision: ``"fp32"``, or ``"bf16"`` for autocast of the networks' arithmetic (parameters,
            gradients and outputs stay float32).
        cores: number of replicas that a CPU computes at once, each by one thread; None for all
            processors of the process. The numbers do not depend on it.
        batched: whether each operation computes all replicas at once; None for yes on a GPU and no
            on a CPU, where only very small networks are faster that way.

    Raises:
        ValueError: for a network with buffers.

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
        members = [make() for _ in range(copies)]
        if next(members[0].buffers(), None) is not None:
            raise ValueError("a Population's network must not have buffers")
        self.copies, self.precision = copies, precision
        self.cores, self.batched = cores, batched
        # All names of each parameter, because layers may share it.
        places: dict[nn.Parameter, list[str]] = {}
        for prefix, module in members[0].named_modules():
            for name, parameter in module.named_parameters(prefix, False, False):
                places.setdefault(parameter, []).append(name)
        self.places = list(places.values())
        self.names = [names[0] for names in self.places]
        self.stacked = nn.ParameterList(
            nn.Parameter(torch.stack([p.detach() for p in parameters]), parameters[0].requires_grad)
            for parameters in zip(*(member.parameters() for member in members), strict=True)
        )
        # In a tuple, so that nn.Module does not register it: only its structure is used.
        self._template = (members[0].to("meta"),)

    def prefer_products(self) -> None:
        """Turns 3x3 convolutions of several replicas into products, which a compiler can fuse."""
        for layer in self._template[0].modules():
            if isinstance(layer, Conv3x3):
                layer.as_product = self.copies > 1

    def forward(self, *inputs: Tensor) -> Any:
        """Applies replica ``k`` to slice ``k`` of each input [K, ...], and stacks the outputs."""
        template, stacked = self._template[0], list(self.stacked)
        batched = stacked[0].device.type != "cpu" if self.batched is None else self.batched
        if self.copies == 1:  # the network that it is
            outputs = self._call(template, [p.squeeze(0) for p in stacked], [x[0] for x in inputs])
            outputs = tuple(output.unsqueeze(0) for output in outputs)
        elif not batched:
            with_graph = torch.is_grad_enabled()  # unknown inside, where gradients are always off
            outputs = _OnCores.apply(self, with_graph, len(inputs), *inputs, *stacked)
        elif getattr(template, "stackable", False):
            outputs = self._call(template, stacked, inputs)
        else:  # convolutions become grouped ones: few launches, for a GPU
            outputs = vmap(partial(self._call, template))(tuple(stacked), inputs)
        return outputs[0] if len(outputs) == 1 else outputs

    def _call(
        self, network: nn.Module, parameters: Sequence[Tensor], inputs: Sequence[Tensor]
    ) -> tuple[Tensor, ...]:
        """Calls a network with these parameters."""
        pairs = zip(self.places, parameters, strict=True)
        named = {name: parameter for names, parameter in pairs for name in names}
        low, device = self.precision == "bf16", parameters[0].device.type
        with torch.autocast(device, torch.bfloat16) if low else nullcontext():
            outputs = functional_call(network, named, tuple(inputs), tie_weights=False)
        if isinstance(outputs, Tensor):
            outputs = (outputs,)
        return tuple(output.float() for output in outputs)


class StackedLinear(nn.Linear):
    """A linear layer whose parameters may be stacked, [K, ...], for inputs [K, *B, features].

    A network made only of such layers sets ``stackable = True``. Its replicas are then computed
    without ``vmap``, which costs as much as the arithmetic of a small network.
    """

    def forward(self, inputs: Tensor) -> Tensor:
        """Returns the layer's outputs, [*B, features] or [K, *B, features]."""
        if self.weight.ndim == 2:
            return F.linear(inputs, self.weight, self.bias)
        rows = inputs.flatten(1, -2)
        outputs = torch.baddbmm(self.bias.unsqueeze(1), rows, self.weight.mT)
        return outputs.unflatten(1, inputs.shape[1:-1])


class Conv3x3(nn.Conv2d):
    """A 3x3 convolution with a border of zeros; the resolution stays.

    In bf16 on a CPU, on small maps with many channels, PyTorch's weight gradient takes several
    times as long as its forward pass. There it is computed as one matrix product; all else is
    PyTorch's.

    Attributes:
        as_product: whether the whole convolution is one product with every pixel's neighbourhood.
            The convolutions of stacked networks are then products of stacks, instead of one kernel
            for each network.
    """

    as_product = False

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__(in_channels, out_channels, 3, padding=1)

    def forward(self, maps: Tensor) -> Tensor:
        """Convolves maps [B, in_channels, H, W] to [B, out_channels, H, W]."""
        assert self.bias is not None
        if self.as_product:
            weight = self.weight.permute(2, 3, 1, 0).flatten(0, 2)  # [9 * in, out]
            pixels = torch.addmm(self.bias, _neighbourhoods(maps), weight)
            pixels = pixels.view(len(maps), *maps.shape[-2:], self.out_channels)
            return pixels.permute(0, 3, 1, 2).clone(memory_format=torch.contiguous_format)
        small = maps.shape[-2] * maps.shape[-1] <= FEW_PIXELS
        small &= min(self.in_channels, self.out_channels) >= MANY_CHANNELS
        if small and maps.device.type == "cpu" and torch.is_autocast_enabled("cpu"):
            low = torch.get_autocast_dtype("cpu")
            return _ProductGradient.apply(maps.to(low), self.weight.to(low), self.bias.to(low))
        return super().forward(maps)


class _ProductGradient(torch.autograd.Function):
    """``F.conv2d`` with padding 1, whose weight gradient is one matrix product."""

    generate_vmap_rule = True

    @staticmethod
    def forward(maps: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        return F.conv2d(maps, weight, bias, padding=1)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[:2])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        maps, weight = ctx.saved_tensors
        pixels = gradient.permute(0, 2, 3, 1).flatten(0, 2)  # [B * H * W, out]
        product = pixels.T.contiguous() @ _neighbourhoods(maps)  # [out, 9 * in]
        of_weight = product.unflatten(1, (3, 3, -1)).permute(0, 3, 1, 2)
        wanted = ctx.needs_input_grad[0]
        of_maps = conv2d_input(maps.shape, weight, gradient, padding=1) if wanted else None
        return of_maps, of_weight, pixels.sum(0)


def _neighbourhoods(maps: Tensor) -> Tensor:
    """Returns the 3x3 pixels around every pixel, [B * H * W, 9 * C] from [B, C, H, W]."""
    height, width = maps.shape[-2:]
    padded = F.pad(maps.permute(0, 2, 3, 1), (0, 0, 1, 1, 1, 1))
    around = [padded[:, r : r + height, c : c + width] for r in range(3) for c in range(3)]
    return torch.cat(around, -1).flatten(0, 2)


class _OnCores(torch.autograd.Function):
    """Runs forward and backward passes of the replicas in threads, each with its own graph."""

    @staticmethod
    def forward(
        ctx: Any, population: Population, with_graph: bool, n_inputs: int, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        needs, pool = ctx.needs_input_grad[3:], _pool(population.cores)

        def one(k: int) -> tuple[tuple[Tensor, ...], list[Tensor]]:
            leaves = [
                x[k].detach().requires_grad_(with_graph and need)
                for x, need in zip(tensors, needs, strict=True)
            ]
            network = _own_network(population._template[0])
            with torch.set_grad_enabled(with_graph):
                outputs = population._call(network, leaves[n_inputs:], leaves[:n_inputs])
            return outputs, leaves

        results = list(pool.map(one, range(len(tensors[-1]))))
        # The graphs live in ctx, not among its saved tensors: they are made here and freed with it.
        ctx.graphs, ctx.pool = results, pool
        outputs = zip(*(outputs for outputs, _ in results), strict=True)
        return tuple(torch.stack([o.detach() for o in slices]) for slices in outputs)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        needs = ctx.needs_input_grad[3:]
        again = torch._C._autograd._get_current_graph_task_keep_graph()  # retain_graph

        def one(k: int) -> tuple[Tensor, ...]:
            outputs, leaves = ctx.graphs[k]
            wanted = [leaf for leaf, need in zip(leaves, needs, strict=True) if need]
            slopes = [g[k] for g in gradients]
            # A parameter that the network does not use has a gradient of zero.
            return torch.autograd.grad(outputs, wanted, slopes, again, materialize_grads=True)

        results = zip(*ctx.pool.map(one, range(len(ctx.graphs))), strict=True)
        stacked = iter([torch.stack(slices) for slices in results])
        ctx.graphs = ctx.graphs if again else None
        return None, None, None, *(next(stacked) if need else None for need in needs)


@cache
def _pool(cores: int) -> ThreadPoolExecutor:
    """Returns threads that each compute on one core."""
    return ThreadPoolExecutor(cores, "replica", initializer=torch.set_num_threads, initargs=(1,))


if hasattr(os, "register_at_fork"):  # not on Windows
    # A forked process inherits the pool, but not its threads.
    os.register_at_fork(after_in_child=_pool.cache_clear)

_networks = threading.local()


def _own_network(network: nn.Module) -> nn.Module:
    """Returns this thread's copy of a template, because functional calls change it."""
    own = getattr(_networks, "of", None)
    if own is None or own[0] is not network:
        own = _networks.of = (network, copy.deepcopy(network))
    return own[1]


def available_cores() -> int:
    """Returns how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def at_hand(tensor: Tensor) -> bool:
    """Returns whether numbers of a tensor can be read without waiting for a device."""
    return tensor.device.type == "cpu"


class TorchDefaultsError(ValueError):
    """A default of torch's would change the numbers of a run; the message is one line."""

    exit_code = 2


def check_torch_defaults() -> None:
    """Refuses a default dtype other than float32, and a default device other than the CPU.

    With either of them, random draws and networks would silently differ.

    Raises:
        TorchDefaultsError: naming torch's own setting, and how to put it back.
    """
    for name, found, wanted, back in (
        ("dtype", torch.get_default_dtype(), torch.float32, "dtype(torch.float32)"),
        ("device", torch.empty(0).device, torch.device("cpu"), "device(None)"),
    ):
        if found != wanted:
            raise TorchDefaultsError(
                f"torch.get_default_{name}() is {found}, and must be {wanted}: put it back with "
                f"torch.set_default_{back}"
            )


def use_device(device: torch.device) -> None:
    """Makes a GPU the current device, with TF32 products and reproducible sums.

    Sums do not depend on the order in which threads finish, so results are the same every time.
    Without a GPU nothing changes.
    """
    if device.type == "cuda":
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        # Torch warns about running sums, whose order only varies along a single long row.
        warnings.filterwarnings("ignore", message="cumsum_cuda_kernel does not have")
        torch.use_deterministic_algorithms(True, warn_only=True)
        torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
        if device.index is not None:  # Ray's workers see none but their own
            torch.cuda.set_device(device)
        torch.set_float32_matmul_precision("high")

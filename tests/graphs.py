"""A CPU's stand-in for CUDA graphs, and a guard against what neither of them can do."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict.nn import CudaGraphModule, cudagraphs
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

# They hand numbers from the device to Python, or to the host to find the shape of their result.
READS = {
    "_local_scalar_dense", "bincount", "equal", "is_nonzero", "masked_select", "nonzero",
    "_unique2", "unique_consecutive", "unique_dim",
}  # fmt: skip


class HostRead(AssertionError):
    """An operation for which the host waits for the device."""


class NoHostReads(TorchDispatchMode):
    """Refuses operations for which a GPU's host would have to wait, wherever the tensors are."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        refuse_host_reads(func, args)
        return func(*args, **(kwargs or {}))


def refuse_host_reads(func: Any, args: tuple[Any, ...]) -> None:
    name = func.overloadpacket.__name__
    masks = name in ("index", "index_put", "index_put_", "_index_put_impl_") and any(
        index is not None and index.dtype == torch.bool for index in args[1]
    )
    lengths = name == "repeat_interleave" and func._overloadname == "Tensor"
    # torch.tensor([...]): on a GPU a copy from memory that the host may change at once.
    if name in READS or masks or lengths or name == "lift_fresh":
        raise HostRead(f"{func} waits for the device")


class Tape(TorchDispatchMode):
    """Records operations with the very tensors that they work on, and repeats them there.

    As with a CUDA graph no Python of the recorded function runs again, results appear where the
    first ones were, and recording itself changes nothing: what it wrote to is put back.
    """

    def __init__(self) -> None:
        super().__init__()
        self._calls: list[tuple[Any, tuple[Any, ...], dict[str, Any], list[Tensor | None]]] = []
        self._own: set[int] = set()
        self._before: dict[int, tuple[Tensor, Tensor]] = {}

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        refuse_host_reads(func, args)
        given = {_memory(tensor) for tensor in _tensors((args, kwargs))}
        for tensor in _written(func, args, kwargs):
            if _memory(tensor) not in self._own | self._before.keys():
                self._before[_memory(tensor)] = (tensor.detach(), tensor.detach().clone())
        result = func(*args, **kwargs)
        fresh = [None if _memory(tensor) in given else tensor for tensor in _tensors(result)]
        self._own |= {_memory(tensor) for tensor in fresh if tensor is not None}
        if func._schema.is_mutable or any(tensor is not None for tensor in fresh):
            self._calls.append((func, args, kwargs, fresh))
        else:
            self._calls.append((None, args, kwargs, _tensors(result)))  # kept, so is its memory
        return result

    def put_back(self) -> None:
        for tensor, before in self._before.values():
            tensor.copy_(before)

    @torch.no_grad()
    def replay(self) -> None:
        for func, args, kwargs, fresh in self._calls:
            if func is None:
                continue
            for old, new in zip(fresh, _tensors(func(*args, **kwargs)), strict=True):
                if old is not None:
                    old.detach().copy_(new)


class Tapes:
    """Lets tensordict's ``CudaGraphModule`` record tapes on the CPU in the place of CUDA graphs.

    Attributes:
        recorded: how many there have been.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.recorded = 0
        stream = SimpleNamespace(wait_stream=lambda other: None)
        for name, stand_in in {
            "is_available": lambda: True,
            "Stream": lambda device: stream,
            "current_stream": lambda device=None: stream,
            "stream": lambda stream: nullcontext(),
            "synchronize": lambda device=None: None,
            "CUDAGraph": Tape,
            "graph": self._record,
        }.items():
            monkeypatch.setattr(torch.cuda, name, stand_in)
        for name in ("PYTREE_REGISTERED_TDS", "PYTREE_REGISTERED_LAZY_TDS"):
            monkeypatch.setattr(cudagraphs, name, ())  # it would take them out for good
        own = staticmethod(lambda tensor: None)
        monkeypatch.setattr(CudaGraphModule, "_check_device_and_grad", own)

    @contextmanager
    def _record(self, tape: Tape, stream: object) -> Iterator[None]:
        self.recorded += 1
        with tape:
            yield
        tape.put_back()


def _tensors(tree: Any) -> list[Tensor]:
    return [leaf for leaf in tree_leaves(tree) if isinstance(leaf, Tensor)]


def _memory(tensor: Tensor) -> int:
    return tensor.untyped_storage()._cdata


def _written(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Iterator[Tensor]:
    for position, argument in enumerate(func._schema.arguments):
        if argument.alias_info is not None and argument.alias_info.is_write:
            value = args[position] if position < len(args) else kwargs.get(argument.name)
            yield from _tensors(value)

"""A guard against operations for which a GPU would make its host wait, on a CPU."""

from __future__ import annotations

from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

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

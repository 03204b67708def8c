"""A guard against operations for which a GPU would make its host wait, on a CPU."""

from __future__ import annotations

from typing import Any, Self
from unittest.mock import patch

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from proposer_rl.models import population

# They hand numbers from the device to Python, or to the host to find the shape of their result.
READS = {
    "_local_scalar_dense", "bincount", "equal", "is_nonzero", "masked_select", "nonzero",
    "_unique2", "unique_consecutive", "unique_dim",
}  # fmt: skip


class HostRead(AssertionError):
    """An operation for which the host waits for the device."""


class NoHostReads(TorchDispatchMode):
    """Refuses operations for which a GPU's host would have to wait, wherever the tensors are.

    What is done otherwise where numbers are at hand is done as on a GPU meanwhile.
    """

    def __enter__(self) -> Self:
        self._elsewhere = patch.object(population, "at_hand", return_value=False)
        self._elsewhere.start()
        return super().__enter__()  # type: ignore[no-any-return]

    def __exit__(self, *raised: Any) -> None:
        super().__exit__(*raised)
        self._elsewhere.stop()

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


class CountedReads(TorchDispatchMode):
    """Counts the operations that :class:`NoHostReads` refuses."""

    count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        try:
            refuse_host_reads(func, args)
        except HostRead:
            self.count += 1
        return func(*args, **(kwargs or {}))

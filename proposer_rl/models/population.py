"""K copies of one network as a single module, their parameters stacked along a first dimension."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from proposer_rl.learning.cuda_graphs import Recorder
from proposer_rl.models.stacked import (
    WAYS,
    Call,
    Way,
    apply_on_cores,
    measure,
)


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
        way: how the copies are computed, one of :data:`~proposer_rl.models.stacked.WAYS`; None for
            cores on a CPU, and on a GPU for the fastest at the first call.
        recorder: of what runs the population, for measuring which way is fastest.
        share: the copies that are computed here, where other processes compute the rest; None for
            all. The outputs of the rest are zeros. They keep their place in the stack, so that
            whatever is done to the stack rounds alike wherever a copy is computed: the last numbers
            of a tensor are often computed in another way than the others.

    Raises:
        ValueError: for fewer than one copy or core, an unknown precision or way, a share that is
            empty or goes beyond the copies, or a network with buffers.

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
        way: str | None = None,
        recorder: Recorder | None = None,
        share: range | None = None,
    ) -> None:
        super().__init__()
        cores = available_cores() if cores is None else cores
        if min(copies, cores) < 1:
            raise ValueError(f"copies and cores must be at least 1, got {copies} and {cores}")
        if precision not in ("fp32", "bf16"):
            raise ValueError(f"precision must be 'fp32' or 'bf16', got {precision!r}")
        if way is not None and way not in WAYS:
            raise ValueError(f"way must be one of {list(WAYS)}, got {way!r}")
        share = range(copies) if share is None else share
        if not (0 <= share.start < share.stop <= copies and share.step == 1):
            raise ValueError(f"share must be a range within {copies} copies, got {share}")
        members = [make() for _ in range(copies)]
        if next(members[0].buffers(), None) is not None:
            raise ValueError("a Population's network must not have buffers")
        self.copies = copies
        self.precision = precision
        self.cores = cores
        self.way = way
        self.share = share
        self._recorder = recorder
        self.names = [name for name, _ in members[0].named_parameters()]
        self.stacked = nn.ParameterList(
            nn.Parameter(torch.stack([p.detach() for p in parameters]))
            for parameters in zip(*(member.parameters() for member in members), strict=True)
        )
        # In a tuple, so that nn.Module does not register it: it lends its structure, no numbers.
        self._template = (members[0].to("meta"),)

    def forward(self, *inputs: Tensor) -> Any:
        """Apply copy ``k`` to slice ``k`` of each input [K, ...]; outputs are stacked, [K, ...]."""
        call = Call(self._template[0], self.names, self.precision)
        outputs = self._chosen_way(inputs)(call, list(self.stacked), inputs)
        return outputs[0] if len(outputs) == 1 else outputs

    def _of_share(
        self, way: Way, call: Call, stacked: Sequence[Tensor], inputs: Sequence[Tensor]
    ) -> tuple[Tensor, ...]:
        """Apply a way that knows no shares."""
        outputs = way(call, self._own(stacked), self._own(inputs))
        return tuple(self._among_all(output) for output in outputs)

    def _own(self, tensors: Iterable[Tensor]) -> list[Tensor]:
        """The share's slices of tensors [K, ...]."""
        whole = len(self.share) == self.copies
        return [x if whole else x[self.share.start : self.share.stop] for x in tensors]

    def _among_all(self, output: Tensor) -> Tensor:
        """A share's output among zeros for the other copies, [K, ...]."""
        before, after = self.share.start, self.copies - self.share.stop
        rest = [output.new_zeros(count, *output.shape[1:]) for count in (before, after)]
        return torch.cat([rest[0], output, rest[1]]) if before or after else output

    def seconds_of_ways(self, *inputs: Tensor) -> dict[str, float]:
        """Measure how long both passes over such inputs [K, ...] take, by each way."""
        call = Call(self._template[0], self.names, self.precision)
        return measure(WAYS, call, self._own(self.stacked), self._own(inputs), self._recorder)

    def _chosen_way(self, inputs: Sequence[Tensor]) -> Way:
        if self.way is None and self.copies > 1:
            if not self.stacked[0].is_cuda:
                return partial(apply_on_cores, cores=self.cores, share=self.share)
            seconds = self.seconds_of_ways(*inputs)
            self.way = min(seconds, key=seconds.__getitem__)
        return partial(self._of_share, WAYS[self.way or "in turn"])


def available_cores() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1

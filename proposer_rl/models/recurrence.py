"""An LSTM through time at once: one graph node, and equal observations are projected once."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import linear
from torchrl.modules import LSTMCell

from proposer_rl.models import population

sigmoid_slope_ = torch.ops.aten.sigmoid_backward.grad_input
tanh_slope_ = torch.ops.aten.tanh_backward.grad_input


def through_time(
    cell: LSTMCell, inputs: Tensor, rows: Tensor, begins: Tensor, memory: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """An LSTM over N sequences of T steps, which forgets where an episode begins.

    Args:
        cell: has the weights of a ``torch.nn.LSTMCell``, of width M.
        inputs: [R, F].
        rows: which of the inputs a step has, int64 [T, N].
        begins: whether an episode begins with the step, bool [T, N, 1].
        memory: before the first step, hidden and cell, [N, M] each.

    Returns:
        Hidden and cell after every step, [T, N, M] each.
    """
    projected = linear(inputs, cell.weight_ih, cell.bias_ih + cell.bias_hh)
    kept, weight = (~begins).to(memory[0]), cell.weight_hh.to(projected.dtype)
    hidden, after, *_ = _ThroughTime.apply(projected, rows, kept, *memory, weight)
    return hidden, after


def distinct(codes: Tensor) -> tuple[Tensor, Tensor]:
    """Finds equal rows by their codes.

    Args:
        codes: int64 [R].

    Returns:
        One row of each kind, int64 [U], and the kind of each row, int64 [R]. On a GPU, which would
        have to be waited for, and under ``vmap`` every row is a kind of its own.
    """
    kinds, kind = _Distinct.apply(codes)
    return kinds, kind


class _Distinct(torch.autograd.Function):
    @staticmethod
    def forward(codes: Tensor) -> tuple[Tensor, Tensor]:
        every = torch.arange(len(codes), device=codes.device)
        if not population.at_hand(codes):
            return every, every.clone()
        kinds, kind = torch.unique(codes, return_inverse=True)
        return torch.empty_like(kinds).scatter_(0, kind, every), kind

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: tuple[Tensor, ...]) -> None:
        ctx.mark_non_differentiable(*output)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], codes: Tensor) -> tuple[Any, Any]:
        every = torch.arange(codes.shape[1 - in_dims[0]], device=codes.device)
        return (every, every.clone()), (None, None)


class _ThroughTime(torch.autograd.Function):
    """The steps one after another, in place; shapes as above, with [K] before N and R under vmap.

    With gates i, f, g and o of the projected inputs and the hidden state before, which is zero
    where an episode begins, as is f: c = f c' + i g and h = o tanh(c) (Hochreiter and Schmidhuber
    1997; Gers et al. 2000).
    """

    @staticmethod
    def forward(
        inputs: Tensor, rows: Tensor, kept: Tensor, hidden: Tensor, cell: Tensor, weight: Tensor
    ) -> tuple[Tensor, ...]:
        width, less = hidden.shape[-1], hidden.new_full((), -1.0)
        # tanh(x) is 2 sigmoid(2 x) - 1, so that one call serves all gates: g is doubled beforehand.
        twice = torch.ones(4 * width, dtype=weight.dtype, device=weight.device)
        twice[2 * width : 3 * width] = 2
        weight = (weight * twice.unsqueeze(-1)).mT.contiguous()
        given = (inputs * twice).index_select(-2, rows.flatten()).to(hidden.dtype)
        gates = given.unflatten(-2, rows.shape).movedim(-3, 0)
        hiddens, cells, squashed = hidden.new_empty(3, len(rows), *hidden.shape)
        # A view of each step, made for all at once.
        steps = (x.unbind() for x in (gates, kept, cells, squashed, hiddens))
        for gate, keep, now, small, after in zip(*steps, strict=True):
            gate.add_(torch.matmul((hidden * keep).to(weight.dtype), weight)).sigmoid_()
            i, f, g, o = gate.chunk(4, -1)
            torch.add(less, g, alpha=2, out=g)
            f.mul_(keep)
            cell = torch.mul(f, cell, out=now).addcmul_(i, g)
            torch.mul(cell, 2, out=small).sigmoid_()
            torch.add(less, small, alpha=2, out=small)
            hidden = torch.mul(o, small, out=after)
        return hiddens, cells, gates, squashed

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: tuple[Tensor, ...]) -> None:
        ctx.mark_non_differentiable(*output[2:])
        ctx.set_materialize_grads(False)
        ctx.distinct, ctx.low = inputs[0].shape, inputs[0].dtype
        ctx.save_for_backward(*inputs[1:], *output)

    @staticmethod
    def backward(ctx: Any, of_hidden: Tensor | None, of_cell: Tensor | None, *_: Any) -> Any:
        rows, kept, hidden, cell, weight, hiddens, cells, gates, squashed = ctx.saved_tensors
        slopes, width = torch.empty_like(gates), hidden.shape[-1]
        to_hidden, to_cell = torch.zeros_like(hidden), torch.zeros_like(cell)
        previous = (cell, *cells.unbind()[:-1])
        none = (None,) * len(rows)
        outer = (none if x is None else x.unbind() for x in (of_hidden, of_cell))
        steps = (x.unbind() for x in (gates, slopes, squashed, kept))
        backwards = reversed(list(zip(*outer, *steps, previous, strict=True)))
        for own_hidden, own_cell, gate, slope, small, keep, before in backwards:
            (i, f, g, o), (si, sf, sg, so) = gate.chunk(4, -1), slope.chunk(4, -1)
            if own_hidden is not None:
                to_hidden.add_(own_hidden)
            if own_cell is not None:
                to_cell.add_(own_cell)
            to_cell.add_(torch.ops.aten.tanh_backward(to_hidden * o, small))
            torch.mul(to_cell, g, out=si)
            torch.mul(to_cell, before, out=sf)
            torch.mul(to_cell, i, out=sg)
            torch.mul(to_hidden, small, out=so)
            both = slope[..., : 2 * width]
            sigmoid_slope_(both, gate[..., : 2 * width], grad_input=both)
            tanh_slope_(sg, g, grad_input=sg)
            sigmoid_slope_(so, o, grad_input=so)
            to_hidden = torch.matmul(slope.to(weight.dtype), weight).to(hidden).mul_(keep)
            to_cell.mul_(f)
        before = torch.cat([hidden.unsqueeze(0), hiddens[:-1]]).mul_(kept)
        slopes, before = (x.movedim(0, -3).flatten(-3, -2) for x in (slopes, before))
        of_weight = torch.matmul(slopes.to(weight.dtype).mT, before.to(weight.dtype))
        of_inputs = gates.new_zeros(ctx.distinct).index_add_(-2, rows.flatten(), slopes)
        return of_inputs.to(ctx.low), None, None, to_hidden, to_cell, of_weight

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *tensors: Tensor) -> tuple[Any, Any]:
        inputs, rows, kept, hidden, cell, weight = (
            x.expand(info.batch_size, *x.shape) if dim is None else x.movedim(dim, 0)
            for x, dim in zip(tensors, in_dims, strict=True)
        )
        rows = tensors[1]  # of codes, which are nobody's own
        return _ThroughTime.apply(inputs, rows, kept.movedim(0, 1), hidden, cell, weight), (1,) * 4

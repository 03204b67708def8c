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
        shape, width = (len(rows), *hidden.shape[:-1]), hidden.shape[-1]
        gates = hidden.new_empty(*shape, 4 * width)
        hiddens, cells, squashed = hidden.new_empty(3, *shape, width)
        for t, row in enumerate(rows):
            before = (hidden * kept[t]).to(weight.dtype)
            gate = torch.add(
                inputs.index_select(-2, row), torch.matmul(before, weight.mT), out=gates[t]
            )
            i, f, g, o = gate.chunk(4, -1)
            g.mul_(2)
            gate.sigmoid_()
            g.mul_(2).sub_(1)
            f.mul_(kept[t])
            cell = torch.mul(f, cell, out=cells[t]).addcmul_(i, g)
            torch.mul(cell, 2, out=squashed[t]).sigmoid_().mul_(2).sub_(1)
            hidden = torch.mul(o, squashed[t], out=hiddens[t])
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
        of_inputs = gates.new_zeros(ctx.distinct)
        to_hidden, to_cell = torch.zeros_like(hidden), torch.zeros_like(cell)
        for t in reversed(range(len(rows))):
            gate, slope = gates[t], slopes[t]
            (i, f, g, o), (si, sf, sg, so) = gate.chunk(4, -1), slope.chunk(4, -1)
            if of_hidden is not None:
                to_hidden.add_(of_hidden[t])
            if of_cell is not None:
                to_cell.add_(of_cell[t])
            to_cell.add_(torch.ops.aten.tanh_backward(to_hidden * o, squashed[t]))
            torch.mul(to_cell, g, out=si)
            torch.mul(to_cell, cells[t - 1] if t else cell, out=sf)
            torch.mul(to_cell, i, out=sg)
            torch.mul(to_hidden, squashed[t], out=so)
            both = slope[..., : 2 * width]
            sigmoid_slope_(both, gate[..., : 2 * width], grad_input=both)
            tanh_slope_(sg, g, grad_input=sg)
            sigmoid_slope_(so, o, grad_input=so)
            of_inputs.index_add_(-2, rows[t], slope)
            to_hidden = torch.matmul(slope.to(weight.dtype), weight).to(hidden).mul_(kept[t])
            to_cell.mul_(f)
        before = torch.cat([hidden.unsqueeze(0), hiddens[:-1]]).mul_(kept)
        flat = [x.movedim(0, -3).flatten(-3, -2).to(weight.dtype) for x in (slopes, before)]
        of_weight = torch.matmul(flat[0].mT, flat[1])
        return of_inputs.to(ctx.low), None, None, to_hidden, to_cell, of_weight

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *tensors: Tensor) -> tuple[Any, Any]:
        inputs, rows, kept, hidden, cell, weight = (
            x.expand(info.batch_size, *x.shape) if dim is None else x.movedim(dim, 0)
            for x, dim in zip(tensors, in_dims, strict=True)
        )
        rows = tensors[1]  # of codes, which are nobody's own
        return _ThroughTime.apply(inputs, rows, kept.movedim(0, 1), hidden, cell, weight), (1,) * 4

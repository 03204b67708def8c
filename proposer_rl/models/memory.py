"""An actor-critic with memory: an LSTM that starts afresh with every episode."""

from __future__ import annotations

import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.distributions import Distribution
from torch.nn.functional import linear
from torchrl.modules import LSTMCell, recurrent_mode

from proposer_rl.models import population
from proposer_rl.models.actor_critic import ActorCritic, categorical, orthogonal_
from proposer_rl.models.population import Population

sigmoid_slope_ = torch.ops.aten.sigmoid_backward.grad_input
tanh_slope_ = torch.ops.aten.tanh_backward.grad_input

MEMORY = ("recurrent_state_h", "recurrent_state_c")
"""Entries of the memory, named as TorchRL's LSTM names them."""


class MemoryNetwork(nn.Module):
    """Encodes observations, remembers them by an LSTM, and has a hidden layer for each head.

    TorchRL's ``LSTMModule`` splits sequences where episodes begin and pads the pieces, which is
    many times the work if episodes have different lengths. Here all sequences run side by side, and
    the memory is set to zero where an episode begins.

    Args:
        encoder: maps observations [N, ...] to features [N, F]. If it has a method ``codes``, which
            maps observations to numbers int64 [N] that only equal observations share, repeated
            observations are encoded once.
        features: number F of features.
        actions: number A of actions.
        memory: width M of the LSTM.
        head: width of the heads' hidden layers.
    """

    def __init__(
        self, encoder: nn.Module, features: int, actions: int, *, memory: int = 256, head: int = 32
    ) -> None:
        super().__init__()
        self.encoder = encoder
        self.cell = LSTMCell(features, memory)  # torch's does not work under vmap
        self.policy = nn.Sequential(nn.Linear(memory, head), nn.ReLU(), nn.Linear(head, actions))
        self.value = nn.Sequential(nn.Linear(memory, head), nn.ReLU(), nn.Linear(head, 1))
        orthogonal_(self)
        for weight in (self.cell.weight_ih, self.cell.weight_hh):
            for gate in weight.data.chunk(4):
                nn.init.orthogonal_(gate)
        for bias in (self.cell.bias_ih, self.cell.bias_hh):
            nn.init.zeros_(bias)
        orthogonal_(self.policy[-1], 0.01)
        orthogonal_(self.value[-1], 1.0)

    def forward(
        self, begins: Tensor, hidden: Tensor, cell: Tensor, *observed: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Reads N sequences of T steps.

        Args:
            begins: whether an episode begins with the step, bool [N, T, 1].
            hidden: of the memory before the first step, float [N, M].
            cell: likewise, float [N, M].
            *observed: inputs of the encoder, [N, T, ...] each.

        Returns:
            Logits [N, T, A], values [N, T, 1], and the memory after every step, [N, T, M] twice.
        """
        count, steps = begins.shape[:2]
        seen = tuple(x.flatten(0, 1) for x in observed)
        if steps == 1:
            kept = (~begins[:, 0]).to(hidden)
            after = self.cell(self.encoder(*seen), (hidden * kept, cell * kept))
            hiddens, cells = (memory.unsqueeze(0) for memory in after)
        else:
            rows = torch.arange(count * steps, device=begins.device)
            codes = getattr(self.encoder, "codes", None)
            if codes is not None:
                kinds, rows = distinct(codes(*seen))
                seen = tuple(x[kinds] for x in seen)
            turns = rows.view(count, steps).T, begins.transpose(0, 1)
            hiddens, cells = through_time(self.cell, self.encoder(*seen), *turns, (hidden, cell))
        outputs = self.policy(hiddens), self.value(hiddens), hiddens, cells
        logits, values, hiddens, cells = (output.transpose(0, 1) for output in outputs)
        return logits, values, hiddens, cells


def memory_actor_critic(
    population: Population,
    observed: Sequence[str],
    memory: int,
    *,
    distribution_class: Callable[..., Distribution] = categorical,
) -> ActorCritic:
    """Makes an actor-critic of K networks with memory.

    As with TorchRL's recurrent modules, ``torchrl.modules.set_recurrent_mode(True)`` makes the last
    batch dimension time: the memory then runs through it, from its entries at the first step.
    Otherwise every element is a single step with its own memory entries. Both write the memory
    after each step below ``next``. ``is_init``, bool [*B, 1], marks where episodes begin.

    Args:
        population: of K networks such as :class:`MemoryNetwork`.
        observed: names of the entries that the encoder takes, in order.
        memory: width M of the memory.
        distribution_class: builds the action's distribution from ``logits=``.
    """
    head = _MemoryHead(population, observed)
    return ActorCritic(
        head,
        distribution_class=distribution_class,
        copies=population.copies,
        memory=dict.fromkeys(MEMORY, memory),
    )


class _MemoryHead(TensorDictModuleBase):
    """Lays tensordicts [K, *B] out as K batches of sequences."""

    def __init__(self, population: Population, observed: Sequence[str]) -> None:
        super().__init__()
        self.population = population
        self.in_keys = ["is_init", *MEMORY, *observed]
        self.out_keys = ["logits", "state_value", *(("next", key) for key in MEMORY)]

    @torch.compiler.disable  # through time is one node that writes in place
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        batch = tensordict.batch_size
        steps = batch[-1] if recurrent_mode() else 1
        begins, hidden, cell, *observed = (
            entry.reshape(batch[0], -1, steps, *entry.shape[len(batch) :])
            for entry in map(tensordict.get, self.in_keys)
        )
        outputs = self.population(begins, hidden[:, :, 0], cell[:, :, 0], *observed)
        for key, output in zip(self.out_keys, outputs, strict=True):
            tensordict.set(key, output.reshape(*batch, *output.shape[3:]))
        return tensordict


def through_time(
    cell: LSTMCell, inputs: Tensor, rows: Tensor, begins: Tensor, memory: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """Runs an LSTM over N sequences of T steps, from zero wherever an episode begins.

    Args:
        cell: has the weights of a ``torch.nn.LSTMCell``, of width M.
        inputs: [R, F].
        rows: the row of the inputs for each step, int64 [T, N].
        begins: whether an episode begins with the step, bool [T, N, 1].
        memory: hidden and cell before the first step, [N, M] each.

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
        One row of each kind, int64 [U], and the kind of each row, int64 [R]. Every row is its own
        kind on a GPU, where comparing would wait for the device, and under ``vmap``.
    """
    return _Distinct.apply(codes)


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


def _forwards(
    gates: Tensor,
    kept: Tensor,
    hidden: Tensor,
    cell: Tensor,
    weight: Tensor,
    hiddens: Tensor,
    cells: Tensor,
    squashed: Tensor,
) -> None:
    """Writes the memory after each step, and replaces the inputs of gates by their values."""
    width = hidden.shape[-1]
    for step in range(len(gates)):
        gate, keep = gates[step], kept[step]
        gate.add_(torch.matmul((hidden * keep).to(weight.dtype), weight))
        i, f, g, o = gate.chunk(4, -1)
        gate[..., : 2 * width].sigmoid_()
        g.tanh_()
        o.sigmoid_()
        f.mul_(keep)
        cell = torch.mul(f, cell, out=cells[step]).addcmul_(i, g)
        hidden = torch.mul(o, torch.tanh(cell, out=squashed[step]), out=hiddens[step])


def _backwards(
    of_hidden: Tensor | None,
    of_cell: Tensor | None,
    slopes: Tensor,
    through: Tensor,
    forget: Tensor,
    kept: Tensor,
    weight: Tensor,
) -> tuple[Tensor, Tensor]:
    """Multiplies the gates' slopes by the gradient of what they make.

    Returns:
        The gradients of hidden and cell before the first step.
    """
    to_hidden, to_cell = torch.zeros_like(through[0]), torch.zeros_like(through[0])
    for step in range(len(slopes) - 1, -1, -1):
        slope = slopes[step].unflatten(-1, (4, -1))
        if of_hidden is not None:
            to_hidden.add_(of_hidden[step])
        if of_cell is not None:
            to_cell.add_(of_cell[step])
        to_cell.addcmul_(to_hidden, through[step])
        slope[..., :3, :].mul_(to_cell.unsqueeze(-2))
        slope[..., 3, :].mul_(to_hidden)
        to_hidden = torch.matmul(slopes[step].to(weight.dtype), weight).to(kept.dtype)
        to_hidden.mul_(kept[step])
        to_cell.mul_(forget[step])
    return to_hidden, to_cell


def _compiled(steps: Any, on: Tensor) -> Any:
    """Returns the loop over steps as TorchScript on CPUs, which has less overhead."""
    # Python 3.14 has no TorchScript; on a GPU the steps are recorded as a graph.
    if not population.at_hand(on) or sys.version_info >= (3, 14):
        return steps
    with _scripting:
        return _scripted(steps)


_scripting = threading.Lock()  # replicas train in threads


@cache
def _scripted(steps: Any) -> Any:
    with warnings.catch_warnings():
        # The recommended replacement would unroll all steps before compiling.
        warnings.filterwarnings("ignore", message=".*torch.jit.script")
        return torch.jit.script(steps)


class _ThroughTime(torch.autograd.Function):
    """Runs the steps in place, one after another; under vmap [K] comes before N and R.

    With gates i, f, g and o of the projected inputs and the hidden state before, which is zero
    where an episode begins, as is f: c = f c' + i g and h = o tanh(c) (Hochreiter and Schmidhuber
    1997; Gers et al. 2000).
    """

    @staticmethod
    def forward(
        inputs: Tensor, rows: Tensor, kept: Tensor, hidden: Tensor, cell: Tensor, weight: Tensor
    ) -> tuple[Tensor, ...]:
        weight = weight.mT.contiguous()
        given = inputs.index_select(-2, rows.flatten()).to(hidden.dtype)
        gates = given.unflatten(-2, rows.shape).movedim(-3, 0)
        hiddens, cells, squashed = hidden.new_empty(3, len(rows), *hidden.shape)
        steps = _compiled(_forwards, gates)
        steps(gates, kept, hidden, cell, weight, hiddens, cells, squashed)
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
        slopes = torch.empty_like(gates)
        (i, f, g, o), (of_i, of_f, of_g, of_o) = gates.chunk(4, -1), slopes.chunk(4, -1)
        sigmoid_slope_(g, i, grad_input=of_i)
        sigmoid_slope_(cell, f[0], grad_input=of_f[0])
        sigmoid_slope_(cells[:-1], f[1:], grad_input=of_f[1:])
        tanh_slope_(i, g, grad_input=of_g)
        sigmoid_slope_(squashed, o, grad_input=of_o)
        through = torch.ops.aten.tanh_backward(o, squashed)
        steps = _compiled(_backwards, gates)
        to_hidden, to_cell = steps(of_hidden, of_cell, slopes, through, f, kept, weight)
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
        rows = tensors[1]  # of codes, which all replicas share
        return _ThroughTime.apply(inputs, rows, kept.movedim(0, 1), hidden, cell, weight), (1,) * 4

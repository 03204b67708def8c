"""An actor-critic with memory: an LSTM that forgets where an episode begins."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.modules import LSTMCell, recurrent_mode

from proposer_rl.models.actor_critic import ActorCritic, categorical
from proposer_rl.models.population import Population
from proposer_rl.models.recurrence import distinct, through_time
from proposer_rl.models.unet import orthogonal_

MEMORY = ("recurrent_state_h", "recurrent_state_c")
"""Entries of the memory, by the names that TorchRL's LSTM has for them."""


class MemoryNetwork(nn.Module):
    """Encodes each observation, remembers by an LSTM, and has one hidden layer for each head.

    TorchRL's ``LSTMModule`` splits sequences where episodes begin and pads the pieces; on a batch
    whose episodes have different lengths that is many times the work. Here all of them go on side
    by side, and the memory of those that begin is set to zero.

    Args:
        encoder: maps observations [N, ...] to features [N, F]. If it has ``codes``, which maps them
            to numbers int64 [N] that are equal only where they are, those that are seen more than
            once are encoded once.
        features: number F of them.
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
        """Go through N sequences of T steps.

        Args:
            begins: bool [N, T, 1], whether an episode begins with the step.
            hidden: of the memory before the first step, float [N, M].
            cell: the same.
            *observed: what the encoder takes, [N, T, ...] each.

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
    """Actor-critic of K networks with memory.

    As with TorchRL's recurrent modules, ``torchrl.modules.set_recurrent_mode(True)`` says that the
    last batch dimension is time: the memory then goes through it from what stands at the first
    step. Otherwise every element is a step of its own with the memory that stands there. Both write
    the memory after each step below ``next``. ``is_init``, bool [*B, 1], says where episodes begin.

    Args:
        population: of K networks such as :class:`MemoryNetwork`.
        observed: entries that the networks' encoder takes, in order.
        memory: width M of their memory.
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

"""A batch cut into equal shuffled parts, for each of K replicas by itself."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from proposer_rl.learning.losses import ACTED_VALUE
from proposer_rl.learning.settings import PPOSettings
from proposer_rl.models import ActorCritic
from proposer_rl.settings import ArgumentError


class Minibatches:
    """Cuts rollouts into parts; what is shuffled are steps.

    They are whole sequences where an agent has a memory, which goes through them, or an encoder,
    which reads a level once for all of its steps.

    Args:
        agent: that trains.
        batch_size: of its environment, [*B], whose first dimension are the replicas if there are.
        settings: PPO's numbers.

    Attributes:
        steps: of the smallest part, of one replica.

    Raises:
        ArgumentError: if there are more parts than steps or sequences.
    """

    def __init__(self, agent: ActorCritic, batch_size: torch.Size, settings: PPOSettings) -> None:
        self._agent, self._settings = agent, settings
        self._lead = 0 if agent.copies is None else 1
        self._sequences = bool(agent.memory or agent.level_keys)
        sequences, length = batch_size[self._lead :].numel(), settings.horizon
        self._count = sequences if self._sequences else sequences * length
        if settings.minibatches > self._count:
            kind = "sequences" if self._sequences else "steps"
            raise ArgumentError(
                f"minibatches={settings.minibatches}: must be at most the {self._count} {kind} of "
                "a batch"
            )
        smallest = self._count // settings.minibatches
        self.steps = smallest * length if self._sequences else smallest

    def draw(self, generators: Sequence[torch.Generator] | None) -> dict[str, Tensor]:
        """The orders of one update, one for each epoch by its entry's name: int64 [K, N] or [N].

        Replica k's come from the k-th generator; without any, from torch's default one.
        """
        settings, copies = self._settings, self._agent.copies
        if settings.minibatches == 1:
            return {}
        device = next(self._agent.parameters()).device
        sources = [None] * (copies or 1) if generators is None else generators[: copies or 1]
        orders = {}
        for update in range(settings.updates):
            for epoch in range(settings.epochs):
                rows = [torch.randperm(self._count, generator=source) for source in sources]
                order = rows[0] if copies is None else torch.stack(rows)
                orders[f"order_{update}_{epoch}"] = order.to(device, non_blocking=True)
        return orders

    def __call__(
        self, steps: TensorDictBase, level: TensorDictBase, order: Tensor | None
    ) -> Iterator[tuple[TensorDictBase, TensorDictBase]]:
        """The parts of steps [*B, T] on a level [*B] in an epoch's order, each with its level.

        Without an order that is all of it as it is.
        """
        if order is None:
            yield steps, level
            return
        agent, lead = self._agent, self._lead
        used = steps.select(
            *agent.step_keys,
            *agent.memory,
            agent.action_key,
            agent.log_prob_key,
            "advantage",
            "value_target",
            ACTED_VALUE,
            strict=False,
        )
        copies = torch.arange(len(order), device=order.device).unsqueeze(-1)
        rows = (copies, order) if lead else (order,)
        shape = (*used.shape[:lead], self._count)
        if self._sequences:
            level, used = level.reshape(shape)[rows], used.reshape(*shape, used.shape[-1])
        else:
            used = used.reshape(shape)
        shuffled = used[rows]
        for part in torch.arange(order.shape[-1]).tensor_split(self._settings.minibatches):
            some = (slice(None),) * lead + (slice(int(part[0]), int(part[-1]) + 1),)
            yield shuffled[some], level[some] if self._sequences else level

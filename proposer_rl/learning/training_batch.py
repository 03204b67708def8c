"""Prepares updates: normalises rollouts and cuts them into shuffled minibatches."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from proposer_rl.learning.objective import ACTED_VALUE, PPOSettings
from proposer_rl.learning.rollout import set_values
from proposer_rl.models import ActorCritic
from proposer_rl.models.actor_critic import Normalization
from proposer_rl.settings import ArgumentError


class Minibatches:
    """Cuts rollouts into minibatches of shuffled steps or sequences.

    Whole sequences are shuffled if the agent has a memory, which goes through them, or an encoder,
    which reads a level once for all of its steps.

    Args:
        agent: trains on them.
        batch_size: of its environment, [*B], whose first dimension are the replicas, if any.
        settings: PPO's numbers.

    Attributes:
        steps: number of steps of one replica in the smallest minibatch.

    Raises:
        ArgumentError: if there are more minibatches than steps or sequences.
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
        """Draws the orders of an update's epochs by entry name: int64 [K, N] or [N].

        Replica k draws from the k-th generator, or without generators from torch's default one.
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
        """Yields the minibatches of steps [*B, T] in an epoch's order, each with its level.

        Without an order it yields the whole batch unchanged.
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


class Statistics:
    """Keeps the running moments by which an agent's observations and values are normalised.

    Observations of a rollout update the moments after training on it, so that training begins with
    the policy that acted; those of the very first rollout come before, because there are no moments
    yet. Rewards update the moments before training, and the values of the rollout are rescaled.

    It sets the agent's ``normalization``, to None if the settings ask for none.

    Attributes:
        discounted: discounted rewards so far of episodes that go on, float64 [*B]; None if all
            begin.

    Raises:
        ArgumentError: if the agent reads its level once for a whole rollout.
    """

    def __init__(self, env: EnvBase, agent: ActorCritic, settings: PPOSettings) -> None:
        self.discounted: Tensor | None = None
        self._agent, self._settings = agent, settings
        for name in ("normalize_observations", "normalize_rewards"):
            if getattr(settings, name) and agent.level_keys:
                raise ArgumentError(
                    f"{name}=True: this Solver reads its level once for a whole rollout; "
                    "leave it False"
                )
        shapes = {}
        if settings.normalize_observations:
            specs = {key: env.observation_spec.get(key, None) for key in agent.step_keys}
            shapes = {
                key: spec.shape[env.batch_dims :]
                for key, spec in specs.items()
                if spec is not None and spec.dtype.is_floating_point
            }
        agent.normalization = None
        if shapes or settings.normalize_rewards:
            numbers = Normalization(agent.copies, shapes, rewards=settings.normalize_rewards)
            agent.normalization = numbers.to(next(agent.parameters()).device)

    def before(self, rollout: TensorDictBase, level: TensorDictBase, *, first: bool) -> None:
        """Updates the moments of rewards by a rollout [*B, T], and rescales its values.

        The first rollout also updates the moments of observations.
        """
        agent, normalization = self._agent, self._agent.normalization
        if normalization is None:
            return
        unit = normalization.unit(rollout[agent.value_key])
        if normalization.returns is not None:
            normalization.returns.update(self._discounted(rollout))
        if first:
            normalization.update_observations(rollout)
            set_values(agent, rollout, level)
        else:
            change = normalization.unit(rollout[agent.value_key]) / unit
            for key in (agent.value_key, ("next", agent.value_key)):
                rollout.set(key, rollout[key] * change)

    def after(self, rollout: TensorDictBase, *, first: bool) -> None:
        """Updates the moments of observations by a rollout [*B, T] that was trained on."""
        if self._agent.normalization is not None and not first:
            self._agent.normalization.update_observations(rollout)

    def in_units(self, steps: TensorDictBase) -> TensorDictBase:
        """Divides values, targets and advantages by the unit of the agent's values."""
        value, normalization = self._agent.value_key, self._agent.normalization
        if normalization is not None and normalization.returns is not None:
            unit = normalization.unit(steps[value])
            for key in {value, ACTED_VALUE, "value_target", "advantage"} & set(steps.keys()):
                steps.set(key, steps[key] / unit)
        return steps

    def _discounted(self, rollout: TensorDictBase) -> Tensor:
        """Sums the discounted rewards of an episode up to each step, float64 [*B, T]."""
        reward = rollout["next", "reward"].squeeze(-1).double()
        going_on = ~rollout["next", "done"].squeeze(-1)
        sums, so_far = [], self.discounted
        for now, goes_on in zip(reward.unbind(-1), going_on.unbind(-1), strict=True):
            total = now if so_far is None else self._settings.gamma * so_far + now
            sums.append(total)
            so_far = total * goes_on
        self.discounted = so_far if self._settings.continue_episodes else None
        return torch.stack(sums, -1)

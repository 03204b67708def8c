"""Proximal policy optimisation of one agent, or of K independent replicas of it at once.

An update, from top to bottom: act for T steps, estimate advantages A, then make S gradient steps,
on all of it or on shuffled parts of it, on

    - min(r A, clip(r, 1 - eps, 1 + eps) A)  +  critic_coeff (V - R)^2  -  entropy_coeff H

with r the new over the old probability of an action, V the critic's value, R its target and H the
policy's entropy (Schulman et al. 2017, eq. 7 and 9). TorchRL computes all of it. What is added: the
level's context is computed once per rollout and once per gradient step, and K replicas train in one
leading dimension as if each were alone. Nothing in an update reads a number from the device.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.modules import set_recurrent_mode

from proposer_rl.learning import graphs, objective
from proposer_rl.learning.objective import MakeLoss, PPOSettings
from proposer_rl.learning.rollout import RolloutCollector, set_next_values, set_values
from proposer_rl.learning.snapshot import (
    complete_adam,
    restore_snapshot,
    set_learning_rate,
    take_snapshot,
)
from proposer_rl.learning.training_batch import Minibatches, Statistics
from proposer_rl.models import ActorCritic, Population, one_copy

DIAGNOSTICS = ("entropy", "kl_approx", "clip_fraction")  # beside the terms, where a loss has them


class Update(NamedTuple):
    """One PPO update: the rollout [*B, T] and its metrics, of K replicas [K], else []."""

    rollout: TensorDictBase
    metrics: TensorDict


class PPO:
    """An agent, the environment it acts in, and its optimiser.

    Args:
        env: batch [*B]; with replicas, B = [K, ...]. Entries that the agent's encoder reads must
            stay the same until the environment is reset.
        agent: the actor-critic; its ``copies`` says whether the first batch dimension holds
            independent replicas, which decides over what losses, advantages and norms are taken.
        settings: PPO's numbers.
        advantage: writes ``advantage`` and ``value_target`` into a rollout with values; None for
            TorchRL's :class:`~torchrl.objectives.value.GAE`.
        loss: makes another TorchRL loss of the agent's actor and critic, with
            ``functional=False`` and ``reduction="none"``, whose terms ``loss_...`` are added up;
            None for :class:`~torchrl.objectives.ClipPPOLoss`.

    Raises:
        ValueError: if the loss reduces what belongs to different replicas.

    Example:
        A linear policy and value for one environment of Gymnasium's:

        >>> from tensordict.nn import TensorDictModule, TensorDictSequential
        >>> from torchrl.envs import GymEnv
        >>> layer = TensorDictModule(torch.nn.Linear(4, 3), ["observation"], ["outputs"])
        >>> split = TensorDictModule(
        ...     lambda x: x.split([2, 1], -1), ["outputs"], ["logits", "state_value"]
        ... )
        >>> agent = ActorCritic(TensorDictSequential(layer, split))
        >>> env = GymEnv("CartPole-v1", categorical_action_encoding=True)
        >>> rollout, metrics = PPO(env, agent, PPOSettings(horizon=50)).update()
        >>> rollout.batch_size
        torch.Size([50])
    """

    def __init__(
        self,
        env: EnvBase,
        agent: ActorCritic,
        settings: PPOSettings,
        *,
        advantage: Callable[[TensorDictBase], TensorDictBase] | None = None,
        loss: MakeLoss | None = None,
    ) -> None:
        self.env, self.agent, self.settings = env, agent, settings
        self.collector = RolloutCollector(
            env, agent, settings.horizon, continued=settings.continue_episodes
        )
        self._minibatches = Minibatches(agent, env.batch_size, settings)
        self.statistics = Statistics(env, agent, settings)
        self._advantage = advantage or objective.gae(
            settings.gamma, settings.lmbda, agent.value_key
        )
        clipped = partial(
            objective.CopiesClipLoss,
            copies=agent.copies,
            clip_epsilon=settings.clip_epsilon,
            entropy_coeff=settings.entropy_coeff,
            critic_coeff=settings.critic_coeff,
            normalize_advantage=settings.normalize_advantage and self._minibatches.steps > 1,
            clip_value=settings.clip_value,
        )
        self._loss = objective.make_loss(loss or clipped, agent)
        self._parameters = list(agent.parameters())
        self._adam = complete_adam(self._parameters, settings.learning_rate, settings.adam_eps)
        self._gradient_steps = 0

    @property
    def copies(self) -> int | None:
        """Returns the number K of replicas; None without."""
        return self.agent.copies

    @property
    def horizon(self) -> int:
        """Returns the steps T of a rollout."""
        return self.settings.horizon

    def update(self, generators: list[torch.Generator] | None = None) -> Update:
        """Collects one batch and trains on it; see :meth:`collect` and :meth:`optimise`."""
        rollout = self.collect(generators)
        return Update(rollout, self.optimise(rollout, generators))

    def collect(self, generators: list[torch.Generator] | None = None) -> TensorDictBase:
        """Resets the environment, unless its episodes go on, and acts for a horizon.

        Args:
            generators: one for each index of the environment's first dimension, from which its
                actions are drawn; None for torch's default generator.

        Returns:
            A complete TorchRL rollout [*B, T]: observations (those of the level expanded along
            time, which takes no memory), actions, log-probabilities, values and ``next``.
        """
        return self.collector.collect(generators)

    @property
    def left(self) -> float:
        """Returns the factor, 0 to 1, by which annealing scales the next update's learning rate."""
        settings = self.settings
        if settings.anneal_updates is None:
            return 1.0
        each = settings.updates * settings.epochs * settings.minibatches
        return max(0.0, 1 - self._gradient_steps / each / settings.anneal_updates)

    @property
    def learning_rate(self) -> float:
        """Returns the learning rate of the next update."""
        return self.settings.learning_rate * self.left

    def optimise(
        self, rollout: TensorDictBase, generators: list[torch.Generator] | None = None
    ) -> TensorDict:
        """Trains on a rollout of the present policy, [*B, T] as :meth:`collect` returns it.

        Writes ``advantage`` and ``value_target`` into the rollout.

        Args:
            rollout: complete.
            generators: as of :meth:`collect`; minibatches are shuffled by them.

        Returns:
            Of each replica [K], without replicas [], means over its batch and the gradient steps:
            the loss's weighted terms, for PPO ``loss_objective``, ``loss_entropy`` and
            ``loss_critic``; ``entropy``, ``kl_approx`` and ``clip_fraction``, where the loss has
            them; ``explained_variance``, ``grad_norm``.
        """
        level = rollout.select(*self.agent.level_keys)[..., 0]
        first = not self._gradient_steps
        self.statistics.before(rollout, level, first=first)
        steps = rollout.exclude(*self.agent.level_keys)
        set_learning_rate(self._adam, self.learning_rate)
        if self.settings.anneal_clip:
            self._loss.clip_epsilon.fill_(self.settings.clip_epsilon * self.left)
        orders = self._minibatches.draw(generators)
        trained = self.train(TensorDict({"steps": steps, "level": level, **orders}))
        self._gradient_steps += len(trained["gradient_steps"])
        rollout.update(trained["steps"])
        self.statistics.after(rollout, first=first)
        self._last_training = rollout["next", "reward"], trained["gradient_steps"]
        return self._last_training[1].mean(0)

    def train(self, batch: TensorDictBase) -> TensorDict:
        """Makes S gradient steps on the ``steps`` [*B, T] of a batch with their ``level`` [*B].

        Returns:
            ``gradient_steps`` [S] or [S, K], the metrics of each; and of the ``steps`` what is
            computed here: values, advantages and targets.
        """
        steps, level, value = batch["steps"].copy(), batch["level"], self.agent.value_key
        taken = []
        for update in range(self.settings.updates):
            if update:
                set_values(self.agent, steps, level)
            self._advantage(steps)
            if self.settings.clip_value is not None:
                steps.set(objective.ACTED_VALUE, steps[value])
            for epoch in range(self.settings.epochs):
                order = batch.get(f"order_{update}_{epoch}", None)
                parts = self._minibatches(steps, level, order)
                taken += [self._gradient_step(*part) for part in parts]
        computed = steps.select(value, ("next", value), "advantage", "value_target")
        return TensorDict({"steps": computed, "gradient_steps": TensorDict.stack(taken)})

    def _gradient_step(self, steps: TensorDictBase, level: TensorDictBase) -> TensorDict:
        with set_recurrent_mode(True):  # an agent with memory goes through the whole rollout again
            loss, metrics = self._forward(steps, level)
        self._adam.zero_grad()
        loss.backward()  # each replica's gradient is its own
        norm = objective.clip_gradients_(self._parameters, self.settings.max_grad_norm, self.copies)
        self._adam.step()
        return TensorDict({**metrics, "grad_norm": norm}, norm.shape)

    def _forward(
        self, steps: TensorDictBase, level: TensorDictBase
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the sum of all losses, and their metrics by name."""
        agent, copies = self.agent, self.copies
        steps = self.statistics.in_units(agent.decode(steps.copy(), agent.encode(level)))
        losses = self._loss(steps)
        metrics = {
            key: objective.of_copies(losses[key], copies)
            for key in losses.keys()
            if key.startswith("loss_") or key in DIAGNOSTICS
        }
        terms = [metric for key, metric in metrics.items() if key.startswith("loss_")]
        metrics["explained_variance"] = objective.explained_variance(steps, agent.value_key, copies)
        return torch.stack(terms).sum(), {key: metric.detach() for key, metric in metrics.items()}

    def complete(self, rollout: TensorDictBase) -> TensorDictBase:
        """Adds what :meth:`optimise` needs to a rollout [*B, T] that another process has made."""
        with torch.no_grad():
            context = self.agent.encode(rollout.select(*self.agent.level_keys)[..., 0])
        set_next_values(self.agent, rollout, context)
        return rollout

    def compile(self) -> PPO:
        """Lets torch.compile fuse what a gradient step computes from here on, for a GPU.

        The first step takes half a minute and more, and numbers are rounded otherwise.

        Returns:
            Itself.
        """
        for module in self.agent.modules():
            if isinstance(module, Population):
                module.prefer_products()
        # Every learner of a process is a case of its own, and after eight it would be given up.
        torch._dynamo.config.recompile_limit = 256
        self._forward = torch.compile(self._forward, dynamic=False)  # type: ignore[method-assign]
        return self

    def replay(self, *, rollouts: bool) -> PPO:
        """Replays training on a GPU as a CUDA graph from here on, which changes no number.

        Args:
            rollouts: whether acting is replayed, too. The environment then reads nothing back from
                the device, and new levels come to where the old ones were.

        Returns:
            Itself.
        """
        self.train = graphs.replayed(self.train)  # type: ignore[method-assign]
        if rollouts and not self.settings.continue_episodes:
            self.collector.act = graphs.replayed(self.collector.act)  # type: ignore[method-assign]
        return self

    def check(self, first: int = 0) -> None:
        """Checks that the last update was finite; this waits for the device, training does not.

        Args:
            first: number of the first replica, by which replicas are named.

        Raises:
            DivergedError: if a reward, loss, gradient or weight is not finite, naming the replica.
        """
        weights = dict(self.agent.named_parameters())
        objective.require_finite(*self._last_training, weights, self.agent.copies, first)

    def replica(self, number: int) -> Replica:
        """Returns one of K replicas by itself; it changes as this learner trains."""
        return Replica(self, number)

    def snapshot(self) -> TensorDict:
        """Returns a copy of weights and Adam's state, batch [K] with replicas and [] without.

        ``snapshot[k]`` is replica ``k``; ``snapshot[[k] * 16]`` is 16 replicas of it.
        """
        return take_snapshot(self.agent, self._adam)

    def restore(self, snapshot: TensorDictBase) -> None:
        """Restores a snapshot of as many replicas; a ValueError says why one does not fit.

        Episodes that would have gone on begin anew.
        """
        self.collector.begin_anew()
        self.statistics.discounted = None
        self._gradient_steps = restore_snapshot(self.agent, self._adam, snapshot)


class Replica:
    """One of the K replicas that train side by side, to be evaluated as if it were alone.

    Its agent lies in the memory of theirs.

    Attributes:
        agent: with one copy, which changes as they are trained.
        settings: PPO's numbers.
    """

    def __init__(self, learner: PPO, number: int) -> None:
        self.agent, self.settings = one_copy(learner.agent, number), learner.settings
        self._learner, self._number = learner, number

    def snapshot(self) -> TensorDict:
        """Returns a copy of its weights and Adam's state, batch [1]."""
        return self._learner.snapshot()[self._number : self._number + 1]

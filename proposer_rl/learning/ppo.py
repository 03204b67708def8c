"""Proximal policy optimisation (PPO) of one agent, or of K independent replicas at once.

An update, from top to bottom: act for T steps, estimate advantages A, then make S gradient steps,
on all of it or on shuffled parts of it, on

    - min(r A, clip(r, 1 - eps, 1 + eps) A)  +  critic_coeff (V - R)^2  -  entropy_coeff H

with r the ratio of the new to the old probability of an action, V the critic's value, R its target
and H the policy's entropy (Schulman et al. 2017, eq. 7 and 9). TorchRL computes all of this. This
module adds two things: the context of a level is computed once per rollout and once per gradient
step, and K replicas train along one leading dimension as if each were alone. An update reads no
number from the device.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.optim import Adam
from torchrl.envs import EnvBase
from torchrl.modules import set_recurrent_mode

from proposer_rl.learning import graphs, objective
from proposer_rl.learning.objective import MakeLoss, PPOSettings
from proposer_rl.learning.rollout import RolloutCollector, set_next_values, set_values
from proposer_rl.learning.training_batch import Minibatches, Statistics
from proposer_rl.models import ActorCritic, Population, one_copy

DIAGNOSTICS = ("entropy", "kl_approx", "clip_fraction")  # besides the terms, if a loss has them


class Update(NamedTuple):
    """One PPO update: the rollout [*B, T] and its metrics, of K replicas [K], else []."""

    rollout: TensorDictBase
    metrics: TensorDict


class PPO:
    """Trains an agent by PPO in an environment.

    Args:
        env: batch [*B]; with replicas, B = [K, ...]. Entries that the agent's encoder reads must
            stay the same until the environment is reset.
        agent: the actor-critic; if it has ``copies``, the first batch dimension holds independent
            replicas, each with its own losses, standardised advantages and gradient norm.
        settings: PPO's numbers.
        advantage: writes ``advantage`` and ``value_target`` into a rollout with values; None for
            TorchRL's :class:`~torchrl.objectives.value.GAE`.
        loss: makes another TorchRL loss from the agent's actor and critic, with
            ``functional=False`` and ``reduction="none"``; its terms ``loss_...`` are summed. None
            for :class:`~torchrl.objectives.ClipPPOLoss`.

    Raises:
        ValueError: if the loss averages over replicas.

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
        made = (loss or clipped)(*agent.readout())
        if made.reduction != "none":
            raise ValueError(f'reduction of the loss must be "none", got {made.reduction!r}')
        made.set_keys(
            action=agent.action_key, sample_log_prob=agent.log_prob_key, value=agent.value_key
        )
        self._loss = made.to(next(agent.parameters()).device)
        self._parameters = list(agent.parameters())
        self._adam = complete_adam(self._parameters, settings.learning_rate, settings.adam_eps)
        self._gradient_steps = 0

    @property
    def copies(self) -> int | None:
        """The number K of replicas; None without."""
        return self.agent.copies

    @property
    def horizon(self) -> int:
        """The number T of steps of a rollout."""
        return self.settings.horizon

    def update(self, generators: list[torch.Generator] | None = None) -> Update:
        """Collects a batch and trains on it; see :meth:`collect` and :meth:`optimise`."""
        rollout = self.collect(generators)
        return Update(rollout, self.optimise(rollout, generators))

    def collect(self, generators: list[torch.Generator] | None = None) -> TensorDictBase:
        """Acts for one horizon, from a reset unless episodes go on.

        Args:
            generators: one for each index of the environment's first dimension, to draw actions;
                None for torch's default generator.

        Returns:
            A complete TorchRL rollout [*B, T]: observations (those of the level expanded along
            time, which takes no memory), actions, log-probabilities, values and ``next``.
        """
        return self.collector.collect(generators)

    @property
    def left(self) -> float:
        """The factor from 1 to 0 by which annealing scales the next learning rate."""
        settings = self.settings
        if settings.anneal_updates is None:
            return 1.0
        each = settings.updates * settings.epochs * settings.minibatches
        return max(0.0, 1 - self._gradient_steps / each / settings.anneal_updates)

    @property
    def learning_rate(self) -> float:
        """The learning rate of the next update."""
        return self.settings.learning_rate * self.left

    def optimise(
        self, rollout: TensorDictBase, generators: list[torch.Generator] | None = None
    ) -> TensorDict:
        """Trains on a rollout of the current policy, [*B, T] as :meth:`collect` returns it.

        Writes ``advantage`` and ``value_target`` into the rollout.

        Args:
            rollout: complete.
            generators: as in :meth:`collect`; they shuffle minibatches.

        Returns:
            Means over the batch and the gradient steps, for each replica [K], without replicas []:
            the weighted terms of the loss, which for PPO are ``loss_objective``, ``loss_entropy``
            and ``loss_critic``; ``entropy``, ``kl_approx`` and ``clip_fraction`` if the loss has
            them; ``explained_variance`` and ``grad_norm``.
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
            ``gradient_steps`` [S] or [S, K], the metrics of each; and ``steps`` with the values,
            advantages and targets that were computed.
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
        with set_recurrent_mode(True):  # agents with memory go through the whole rollout again
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
        """Adds the values that :meth:`optimise` needs to a rollout [*B, T] of another process."""
        with torch.no_grad():
            context = self.agent.encode(rollout.select(*self.agent.level_keys)[..., 0])
        set_next_values(self.agent, rollout, context)
        return rollout

    def compile(self) -> PPO:
        """Compiles the computation of gradient steps with torch.compile, for a GPU.

        The first step takes half a minute or more, and numbers are rounded differently.

        Returns:
            Itself.
        """
        for module in self.agent.modules():
            if isinstance(module, Population):
                module.prefer_products()
        # Each learner of a process is compiled anew, and after eight torch would give up.
        torch._dynamo.config.recompile_limit = 256
        self._forward = torch.compile(self._forward, dynamic=False)  # type: ignore[method-assign]
        return self

    def replay(self, *, rollouts: bool) -> PPO:
        """Replays training on a GPU as a CUDA graph from now on, with the same numbers.

        Args:
            rollouts: whether to replay acting, too. The environment then must read nothing back
                from the device, and put new levels in the memory of the old ones.

        Returns:
            Itself.
        """
        self.train = graphs.replayed(self.train)  # type: ignore[method-assign]
        if rollouts and not self.settings.continue_episodes:
            self.collector.act = graphs.replayed(self.collector.act)  # type: ignore[method-assign]
        return self

    def check(self, first: int = 0) -> None:
        """Checks that the last update was finite, which waits for the device.

        Args:
            first: number of the first replica, by which replicas are named.

        Raises:
            DivergedError: if a reward, loss, gradient or weight is not finite, naming the replica.
        """
        weights = dict(self.agent.named_parameters())
        objective.require_finite(*self._last_training, weights, self.agent.copies, first)

    def replica(self, number: int) -> Replica:
        """Returns a view of one of K replicas, which changes as this learner trains."""
        return Replica(self, number)

    def snapshot(self) -> TensorDict:
        """Copies weights and Adam's state: batch [K] with replicas, [] without.

        ``snapshot[k]`` is replica ``k``; ``snapshot[[k] * 16]`` is 16 replicas of it.
        """
        return take_snapshot(self.agent, self._adam)

    def restore(self, snapshot: TensorDictBase) -> None:
        """Restores a snapshot with the same number of replicas; all episodes begin anew.

        Raises:
            ValueError: if the snapshot does not fit.
        """
        self.collector.begin_anew()
        self.statistics.discounted = None
        self._gradient_steps = restore_snapshot(self.agent, self._adam, snapshot)


class Replica:
    """A view of one of K replicas, to be evaluated as if it were alone.

    Attributes:
        agent: with one copy, in the memory of the learner's agent, so it changes in training.
        settings: PPO's numbers.
    """

    def __init__(self, learner: PPO, number: int) -> None:
        self.agent, self.settings = one_copy(learner.agent, number), learner.settings
        self._learner, self._number = learner, number

    def snapshot(self) -> TensorDict:
        """Copies its weights and Adam's state, batch [1]."""
        return self._learner.snapshot()[self._number : self._number + 1]


def complete_adam(parameters: Sequence[nn.Parameter], learning_rate: float, eps: float) -> Adam:
    """Makes Adam with its state, which torch would make at the first step.

    On a GPU the learning rate is a tensor there, so that a recorded graph reads the value that
    :func:`set_learning_rate` sets.
    """
    rate: float | Tensor = learning_rate
    on_gpu = parameters[0].is_cuda
    if on_gpu:
        rate = torch.tensor(learning_rate, device=parameters[0].device)
    adam = Adam(parameters, lr=rate, eps=eps, fused=True, capturable=on_gpu)
    for parameter in parameters:
        adam.state[parameter] = {
            "step": torch.zeros((), device=parameter.device),
            "exp_avg": torch.zeros_like(parameter),
            "exp_avg_sq": torch.zeros_like(parameter),
        }
    return adam


def set_learning_rate(adam: Adam, learning_rate: float) -> None:
    """Sets the learning rate of the next steps."""
    for group in adam.param_groups:
        if isinstance(group["lr"], Tensor):
            group["lr"].fill_(learning_rate)
        else:
            group["lr"] = learning_rate


def take_snapshot(agent: ActorCritic, adam: Adam) -> TensorDict:
    """Copies weights and Adam's state: batch [K] with replicas, [] without."""
    batch = _batch(agent)
    entries: dict[str, TensorDict] = {}
    for name, value in agent_values(agent).items():
        entry = {"value": value.detach().clone()}
        if value in adam.state:
            state = adam.state[value]
            entry |= {key: state[key].clone() for key in ("exp_avg", "exp_avg_sq")}
            entry["step"] = state["step"].expand(batch).clone()
        entries[name] = TensorDict(entry, batch)
    return TensorDict(entries, batch)


def restore_snapshot(agent: ActorCritic, adam: Adam, snapshot: TensorDictBase) -> int:
    """Restores a snapshot with the same number of replicas (in place).

    Returns:
        The number of Adam's steps so far.

    Raises:
        ValueError: if it belongs to another network, or its replicas differ in Adam's steps.
    """
    load_agent(agent, snapshot)
    parameters = dict(agent.named_parameters())
    steps = torch.stack([snapshot[name, "step"].flatten() for name in parameters])
    # The only line here that waits for the device.
    if not bool((steps == steps[:, :1]).all()):
        raise ValueError("the snapshot's copies have made different numbers of Adam steps")
    for name, parameter in parameters.items():
        entry, state = snapshot[name], adam.state[parameter]
        state["exp_avg"].copy_(entry["exp_avg"])
        state["exp_avg_sq"].copy_(entry["exp_avg_sq"])
        state["step"].copy_(entry["step"].flatten()[0])
    return int(steps.max())  # of frozen parameters there are none


def _batch(agent: ActorCritic) -> torch.Size:
    return torch.Size([] if agent.copies is None else [agent.copies])


def agent_values(agent: ActorCritic) -> dict[str, Tensor]:
    """Returns an agent's weights and the moments of its observations and rewards, by name."""
    learnt = agent.normalization
    moments = () if learnt is None else learnt.named_buffers("normalization")
    return dict([*agent.named_parameters(), *moments])


def agent_weights(agent: ActorCritic) -> TensorDict:
    """Copies an agent's weights and moments, batch [], for :func:`load_agent`."""
    values = agent_values(agent)
    return TensorDict({name: {"value": value.detach().clone()} for name, value in values.items()})


def load_agent(agent: ActorCritic, snapshot: TensorDictBase) -> None:
    """Loads the weights and moments of a snapshot into an agent (in place).

    Raises:
        ValueError: if they belong to another network.
    """
    values = agent_values(agent)
    shapes = {name: value.shape for name, value in values.items()}
    if shapes != {name: snapshot[name, "value"].shape for name in snapshot.keys()}:
        raise ValueError("the snapshot belongs to another network: its parameters differ")
    for name, value in values.items():
        value.data.copy_(snapshot[name, "value"])

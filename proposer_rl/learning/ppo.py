"""Proximal policy optimisation of one agent, or of K independent copies of it at once.

TorchRL's ``Collector``, ``GAE`` and ``ClipPPOLoss`` do the work. What is added here: the level's
context is computed once per rollout and once per epoch, K copies train in one leading dimension as
if each were alone, everything that training changes can be taken out and put back, and on a GPU a
rollout and the training on it are one CUDA graph each. To that end nothing in them looks at a
number on the device.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution, Independent
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, ExcludeTransform, TransformedEnv
from torchrl.objectives import ClipPPOLoss, LossModule
from torchrl.objectives.value import GAE

from proposer_rl.learning.adam import CopiesAdam
from proposer_rl.learning.cuda_graphs import Captured, Recorder
from proposer_rl.learning.divergence import require_finite
from proposer_rl.models import ActorCritic, draw, uniform_noise
from proposer_rl.settings import PPOSettings

# From an actor and a critic that read what stands in a tensordict already, to a loss of both.
MakeLoss = Callable[[TensorDictModuleBase, TensorDictModule], LossModule]


class Update(NamedTuple):
    """What one PPO update was made of: the rollout [*B, T] and the scalars of its training."""

    rollout: TensorDictBase
    metrics: TensorDict


class PPO:
    """An agent, the environment it acts in, and its optimiser.

    Args:
        env: batch [*B]; with copies, B = [K, ...]. Entries that the agent's encoder reads must
            stay the same until the environment is reset.
        agent: the actor-critic; its ``copies`` says whether the first batch dimension holds
            independent copies, which decides over what losses, advantages and norms are taken.
        settings: PPO's numbers.
        recorder: records rollouts and training, which a GPU then replays; None to run them as they
            are. A recorded environment starts an episode from the same memory every time.
        advantage: writes ``advantage`` and ``value_target`` into a rollout with values; None for
            TorchRL's :class:`GAE` with the settings' numbers.
        loss: makes another TorchRL loss of the agent's actor and critic, with
            ``functional=False`` and ``reduction="none"``; the terms that it returns as ``loss_...``
            are added up. None for :class:`ClipPPOLoss` with the settings' numbers.

    Raises:
        ValueError: if the environment's first dimension is not the agent's number of copies, or
            the loss reduces what belongs to different copies.

    Example:
        >>> from proposer_rl import MazeEnv, Population, UNet, generate_levels
        >>> from proposer_rl.models import map_actor_critic
        >>> copies = Population(lambda: UNet(channels=(8, 8)), copies=2)
        >>> env = MazeEnv(generate_levels(torch.full((2, 4), 0.2), 4, 6, 6))
        >>> learner = PPO(env, map_actor_critic(copies), PPOSettings(horizon=5, epochs=1))
        >>> rollout, metrics = learner.update()
        >>> rollout.batch_size
        torch.Size([2, 4, 5])
    """

    def __init__(
        self,
        env: EnvBase,
        agent: ActorCritic,
        settings: PPOSettings,
        recorder: Recorder | None = None,
        *,
        advantage: Callable[[TensorDictBase], TensorDictBase] | None = None,
        loss: MakeLoss | None = None,
    ) -> None:
        if agent.copies is not None and env.batch_size[:1] != (agent.copies,):
            raise ValueError(
                f"the agent has {agent.copies} copies, so the environment's first dimension must "
                f"be {agent.copies}; its batch size is {list(env.batch_size)}"
            )
        self.env = env
        self.agent = agent
        self.settings = settings
        self._level = _LevelAside(*agent.level_keys)
        self._policy = RolloutPolicy(agent)
        self._collector = Collector(
            _WithoutLevel(env, self._level),
            self._policy,
            frames_per_batch=env.batch_size.numel() * settings.horizon,
            total_frames=-1,
            reset_at_each_iter=True,
            use_buffers=False,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
            no_cuda_sync=True,
        )
        # TorchRL's vectorised form splits the batch where episodes end, which it has to look up.
        gae = GAE(gamma=settings.gamma, lmbda=settings.lmbda, value_network=None, vectorized=False)
        gae.set_keys(value=agent.value_key)
        self._advantage = advantage or gae
        self._loss = (loss or partial(_clip_ppo_loss, settings, agent.copies))(*agent.readout())
        if self._loss.reduction != "none":
            raise ValueError(f'reduction of the loss must be "none", got {self._loss.reduction!r}')
        self._loss.set_keys(
            action=agent.action_key, sample_log_prob=agent.log_prob_key, value=agent.value_key
        )
        self._parameters = list(agent.parameters())
        device = self._parameters[0].device
        self._loss.to(device)
        self._adam = CopiesAdam(
            self._parameters, agent.copies, settings.learning_rate, settings.adam_eps
        )
        self._act = Captured(self._roll_out, recorder)
        self._train = Captured(self._train_on, recorder)

    def update(self, generators: list[torch.Generator] | None = None) -> Update:
        """Collect one batch and train on it.

        Args:
            generators: see :meth:`collect`.
        """
        rollout = self.collect(generators)
        return Update(rollout, self.optimise(rollout))

    def collect(self, generators: list[torch.Generator] | None = None) -> TensorDictBase:
        """Reset the environment and act for a horizon.

        Args:
            generators: one for each index of the environment's first dimension, from which its
                actions are drawn; None for torch's default generator.

        Returns:
            A complete TorchRL rollout [*B, T]: observations (those of the level expanded along
            time, which takes no memory), actions, log-probabilities, values and ``next``.
        """
        shape = self.env.full_action_spec[self.agent.action_key].shape
        device = self._parameters[0].device
        noise = uniform_noise(shape, self.settings.horizon, generators, device)
        acted = self._act(TensorDict({"noise": noise}))
        rollout, level = acted["rollout"], acted["level"]
        for key, entry in level.items(include_nested=True, leaves_only=True):
            along_time = entry.unsqueeze(level.ndim)
            rollout.set(key, along_time.expand(*rollout.shape, *entry.shape[level.ndim :]))
        return rollout

    @torch.no_grad()
    def complete(self, rollout: TensorDictBase) -> TensorDictBase:
        """Add what :meth:`optimise` needs to a rollout [*B, T] of a :class:`RolloutPolicy`.

        For a rollout that another collector than this one's has made, in another process.
        """
        context = self.agent.encode(rollout.select(*self.agent.level_keys)[..., 0])
        self._set_next_values(rollout, context)
        return rollout

    def optimise(self, rollout: TensorDictBase) -> TensorDict:
        """Train on a rollout of the present policy, [*B, T] as :meth:`collect` returns it.

        Writes ``advantage`` and ``value_target`` into the rollout.

        Returns:
            Scalars averaged over the gradient steps: the loss's terms, for PPO ``loss_objective``,
            ``loss_entropy`` and ``loss_critic`` (the mean over copies of their weighted losses);
            ``entropy``, ``kl_approx`` and ``clip_fraction``, as far as the loss tells them;
            ``explained_variance`` and ``grad_norm``.
        """
        agent = self.agent
        steps = rollout.select(
            *agent.step_keys,
            agent.action_key,
            agent.log_prob_key,
            agent.value_key,
            *(("next", key) for key in [*agent.step_keys, agent.value_key]),
            *(("next", key) for key in ["reward", "done", "terminated"]),
        )
        level = rollout.select(*agent.level_keys)[..., 0]
        trained = self._train(TensorDict({"steps": steps, "level": level}))
        rollout.update(trained["steps"])
        taken = trained["metrics"]  # [S], with entries [S, K] or [S]
        self._last_training = rollout["next", "reward"], taken
        return TensorDict({key: value.mean() for key, value in taken.items()})

    @property
    def gradient_steps(self) -> TensorDictBase:
        """Of the last training, [S]: what each step was like, for each copy [S, K] where told."""
        return self._last_training[1]

    def check(self) -> None:
        """Check what was trained on last; this waits for the device, training does not.

        Raises:
            DivergedError: if a reward, loss, gradient or weight is not finite, naming the copy.
        """
        weights = dict(self.agent.named_parameters())
        require_finite(*self._last_training, weights, self.agent.copies)

    def snapshot(self) -> TensorDict:
        """A copy of weights and Adam's state, batch [K] with copies and [] without.

        ``snapshot[k]`` is copy ``k``; ``snapshot[[k] * 16]`` is 16 copies of it.
        """
        batch = self._batch
        entries: dict[str, TensorDict] = {}
        for i, (name, parameter) in enumerate(self.agent.named_parameters()):
            state = self._adam.state(i)
            entries[name] = TensorDict(
                {
                    "value": parameter.detach().clone(),
                    "exp_avg": state["exp_avg"].clone(),
                    "exp_avg_sq": state["exp_avg_sq"].clone(),
                    "step": state["step"].expand(batch).clone(),
                },
                batch,
            )
        return TensorDict(entries, batch)

    def restore(self, snapshot: TensorDictBase) -> None:
        """Put a snapshot of as many copies back.

        Raises:
            ValueError: if its batch, a parameter's name or shape, or Adam's steps do not fit.
        """
        if snapshot.batch_size != self._batch:
            raise ValueError(
                f"the snapshot must have batch size {list(self._batch)}, "
                f"got {list(snapshot.batch_size)}"
            )
        parameters = dict(self.agent.named_parameters())
        if parameters.keys() != set(snapshot.keys()):
            raise ValueError("the snapshot belongs to another network: its parameters differ")
        for name, parameter in parameters.items():
            if snapshot[name, "value"].shape != parameter.shape:
                raise ValueError(f"the snapshot's {name} does not fit: another shape")
        steps = torch.stack([snapshot[name, "step"].flatten() for name in parameters])
        # The one question here that waits for the device.
        if not bool((steps == steps[:, :1]).all()):
            raise ValueError("the snapshot's copies have made different numbers of Adam steps")
        for i, (name, parameter) in enumerate(parameters.items()):
            entry, state = snapshot[name], self._adam.state(i)
            parameter.data.copy_(entry["value"])
            state["exp_avg"].copy_(entry["exp_avg"])
            state["exp_avg_sq"].copy_(entry["exp_avg_sq"])
            state["step"].copy_(entry["step"].flatten()[0])

    @property
    def _batch(self) -> torch.Size:
        return torch.Size([] if self.agent.copies is None else [self.agent.copies])

    @torch.no_grad()
    def _roll_out(self, inputs: TensorDictBase) -> TensorDict:
        self._policy.begin(inputs["noise"], self._level)
        rollout = self._collector.rollout()
        self._set_next_values(rollout, self._policy.context)
        return TensorDict({"rollout": rollout, "level": self._level.entries})

    def _train_on(self, inputs: TensorDictBase) -> TensorDict:
        rollout, level = inputs["steps"].copy(), inputs["level"]
        metrics = []
        for update in range(self.settings.updates):
            if update:
                self._set_values(rollout, level)
            self._advantage(rollout)
            metrics += [self._gradient_step(rollout, level) for _ in range(self.settings.epochs)]
        value = self.agent.value_key
        return TensorDict(
            {
                "steps": rollout.select(value, ("next", value), "advantage", "value_target"),
                "metrics": TensorDict.stack(metrics),
            }
        )

    @torch.no_grad()
    def _set_values(self, rollout: TensorDictBase, level: TensorDictBase) -> None:
        context = self.agent.encode(level)
        steps = self.agent.decode(rollout.select(*self.agent.step_keys), context)
        rollout.set(self.agent.value_key, steps.get(self.agent.value_key))
        self._set_next_values(rollout, context)

    def _set_next_values(self, rollout: TensorDictBase, context: TensorDictBase) -> None:
        after = self.agent.decode(rollout.get("next").select(*self.agent.step_keys), context)
        rollout.set(("next", self.agent.value_key), after.get(self.agent.value_key))

    def _gradient_step(self, batch: TensorDictBase, level: TensorDictBase) -> TensorDict:
        steps = self.agent.decode(batch.copy(), self.agent.encode(level))
        losses = self._loss(steps)
        # [K] or []: each copy's loss is the mean over its own batch, as if it were alone.
        terms = {
            key: term.flatten(len(self._batch)).mean(-1)
            for key, term in losses.items()
            if key.startswith("loss_")
        }
        self._adam.zero_grad()
        torch.stack(list(terms.values())).sum().backward()
        norm = clip_gradients_(self._parameters, self.settings.max_grad_norm, self.agent.copies)
        self._adam.step()
        metrics = {key: term.detach() for key, term in terms.items()}
        for key in ("entropy", "kl_approx", "clip_fraction"):
            if key in losses.keys():
                metrics[key] = losses[key].detach().mean()
        value = steps.get(self.agent.value_key).detach()
        metrics["explained_variance"] = self._explained_variance(value, steps["value_target"])
        return TensorDict({**metrics, "grad_norm": norm})

    def _explained_variance(self, value: Tensor, target: Tensor) -> Tensor:
        """Share of the targets' variance that the values explain, the mean over copies."""
        residual, total = (
            x.flatten(len(self._batch)).var(-1, correction=0) for x in (target - value, target)
        )
        return (1 - residual / total.clamp_min(1e-12)).mean()


def _clip_ppo_loss(
    settings: PPOSettings, copies: int | None, actor: TensorDictModuleBase, critic: TensorDictModule
) -> LossModule:
    return _ClipPPOLoss(
        actor,
        critic,
        clip_epsilon=settings.clip_epsilon,
        entropy_coeff=settings.entropy_coeff,
        critic_coeff=settings.critic_coeff,
        loss_critic_type="l2",
        normalize_advantage=settings.normalize_advantage,
        normalize_advantage_exclude_dims=() if copies is None else (0,),
        functional=False,
        reduction="none",
        # TorchRL's takes the variance over the first dimension alone; see _gradient_step.
        log_explained_variance=False,
    )


class _ClipPPOLoss(ClipPPOLoss):
    """TorchRL's, without looking whether an entropy is finite: for discrete actions it is."""

    def _get_entropy(self, dist: Distribution, adv_shape: torch.Size) -> Tensor:
        if isinstance(dist, Categorical | Independent):
            return dist.entropy().unsqueeze(-1)
        return super()._get_entropy(dist, adv_shape)


class RolloutPolicy(TensorDictModuleBase):
    """What a collector calls: reads the steps off the context and draws actions from noise.

    :meth:`begin` comes before every rollout.

    Args:
        agent: its parameters do not become the policy's, so that a collector leaves them be.
    """

    context: TensorDictBase

    def __init__(self, agent: ActorCritic) -> None:
        super().__init__()
        # In a tuple, nn.Module does not register it.
        self._agent = (agent,)
        self.in_keys = agent.step_keys
        self.out_keys = [agent.action_key, agent.log_prob_key, agent.value_key]

    def begin(self, noise: Tensor, level: _LevelAside | None = None) -> None:
        """Expect a rollout with this noise [T, ...].

        Args:
            noise: uniform numbers in [0, 1), one for each element of T actions.
            level: where the next reset puts the level aside; None where it stays in every step.
        """
        self._steps = enumerate(noise)
        self._level = (level,)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write action, log-probability and value of the next step."""
        (agent,), (level,) = self._agent, self._level
        index, noise = next(self._steps)
        if index == 0:
            self.context = agent.encode(tensordict if level is None else level.entries)
        step = agent.decode(tensordict.select(*agent.step_keys), self.context)
        distribution = agent.distribution(step)
        action = draw(distribution, noise)
        tensordict.set(agent.action_key, action)
        tensordict.set(agent.log_prob_key, distribution.log_prob(action))
        return tensordict.set(agent.value_key, step.get(agent.value_key))


class _LevelAside(ExcludeTransform):
    """Puts entries aside that the collector would copy at every step, at each whole reset."""

    entries: TensorDictBase

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self.entries = tensordict_reset.select(*self.excluded_keys)
        return super()._reset(tensordict, tensordict_reset)


class _WithoutLevel(TransformedEnv):
    """An environment without those entries, whose own way of resetting what is done is kept."""

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.base_env.maybe_reset(tensordict).exclude(*self.transform.excluded_keys)


def clip_gradients_(parameters: list[nn.Parameter], max_norm: float, copies: int | None) -> Tensor:
    """Scale gradients (in place) so that no copy's norm exceeds ``max_norm``.

    Args:
        parameters: with copies, each [K, ...].
        max_norm: largest norm over all parameters of one copy.
        copies: K, or None if the parameters belong to a single network.

    Returns:
        The norms before clipping, [K] or [].
    """
    if copies is None:
        return nn.utils.clip_grad_norm_(parameters, max_norm)
    gradients = [p.grad for p in parameters if p.grad is not None]
    # Slice by slice, since a norm over a row of several is rounded otherwise than over one alone.
    slices = [gradient[k] for k in range(copies) for gradient in gradients]
    norms = torch.stack(torch._foreach_norm(slices)).view(copies, len(gradients))
    norm = norms.square().sum(1).sqrt()  # [K]
    scale = (max_norm / (norm + 1e-6)).clamp(max=1.0)
    for gradient in gradients:
        gradient.mul_(scale.view(-1, *[1] * (gradient.ndim - 1)))
    return norm

"""The paper's Proposer, paid for each problem by itself."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import ClipPPOLoss

from proposer_rl.curricula.base import Curriculum, Improvement, Proposal
from proposer_rl.curricula.checks import real, whole
from proposer_rl.curricula.choice import Choice
from proposer_rl.curricula.proposer import learnt_proposer
from proposer_rl.learning import PPO
from proposer_rl.learning.divergence import located, require_finite
from proposer_rl.models import ActorCritic, draw
from proposer_rl.settings import PPOSettings
from proposer_rl.streams import Streams
from proposer_rl.task import Levels, Task


class Worth(NamedTuple):
    """What problems are worth.

    Attributes:
        paid: for each, float [K, E].
        told: of all of them, by name.
        frames: environment steps that it cost each Solver.
        evaluations: of a policy on a level, for each Solver.
    """

    paid: Tensor
    told: dict[str, float]
    frames: int = 0
    evaluations: int = 0


class ProblemProposer(Curriculum):
    """Draws each of P problems from a policy over probes, and learns what each was worth.

    At every update the policy sees what the Solver would do on probe levels of the target, draws
    the bin of each problem, and is paid for each, standardised over all that it drew. A few
    gradient steps follow on the clipped objective of each problem (Schulman et al. 2017, eq. 7),
    with no critic. What problems are worth is known before anybody trains on them: where the Solver
    trains on a choice among more of them, the policy learns from all that it drew.

    Args:
        task: whose target is seen, and whose space has the bins.
        agent: from ``probes`` [K, C, ...] to logits [K, P, N] of independent categoricals, as
            :func:`~proposer_rl.models.proposer_actor_critic` makes it of a ``ProblemHead``.
        settings: of these, ``epochs``, ``learning_rate``, ``adam_eps``, ``clip_epsilon``,
            ``entropy_coeff`` and ``max_grad_norm`` count.
        probe_levels: probes C.
        choice: of the levels that are trained on, among several times as many draws; None for all.

    Raises:
        ValueError: if a number is out of range.
    """

    def __init__(
        self,
        task: Task,
        agent: ActorCritic,
        settings: PPOSettings,
        *,
        probe_levels: int = 16,
        choice: Choice | None = None,
    ) -> None:
        self.agent, self.task = agent, task
        whole("epochs", settings.epochs, 1)
        real("learning_rate", settings.learning_rate, above=0)
        real("entropy_coeff", settings.entropy_coeff, least=0)
        self._settings = settings
        self._choice = choice
        self._probe_levels = probe_levels
        actor, _ = agent.readout()
        self._loss = ClipPPOLoss(
            actor,
            None,
            clip_epsilon=settings.clip_epsilon,
            entropy_coeff=settings.entropy_coeff,
            normalize_advantage=True,
            functional=False,
        ).to(task.device)  # its numbers are tensors
        self._loss.set_keys(action=agent.action_key, sample_log_prob=agent.log_prob_key)
        self._parameters = [p for p in agent.parameters() if p.requires_grad]
        self._adam = torch.optim.Adam(
            self._parameters, lr=settings.learning_rate, eps=settings.adam_eps
        )
        self.begin()

    def begin(self) -> None:
        """Nothing of the last Solver's cycle is told of the next one."""
        self._proposed = torch.zeros(self.task.space.size, dtype=torch.int64)
        self._told: dict[str, float] = {}

    @abstractmethod
    def worth(self, learner: PPO, levels: Levels, streams: Sequence[Streams]) -> Worth:
        """What each of the levels [K, E] is worth to its Solver, who has not trained on it yet."""

    def propose(self, learner: PPO, updates: int, streams: Sequence[Streams]) -> Proposal:
        """Levels [1, P] of the policy's draws, from all of which it has learnt already.

        Raises:
            ValueError: for several Solvers: a Proposer learns from one.
        """
        if len(streams) != 1:
            raise ValueError(f"a Proposer learns from one Solver, got {len(streams)}")
        bins, proposal = self.draw_and_learn(learner, streams)
        self._proposed += bins.flatten().bincount(minlength=len(self._proposed))
        return proposal

    def draw_and_learn(self, learner: PPO, streams: Sequence[Streams]) -> tuple[Tensor, Proposal]:
        """Draw for K Solvers that are all seen through the same probes, and learn from all draws.

        Returns:
            The bins of their levels, int64 [K, P], and the levels [K, P].
        """
        task, agent = self.task, self.agent
        probes = task.target.sample(self._probe_levels, streams[0].generator("probes"))
        with torch.no_grad():
            seen = TensorDict({"probes": task.probe(learner.agent, probes)}, [len(streams)])
            policy = agent.distribution(agent(seen.copy()))
            shape = (self._choice.times if self._choice else 1, task.batch_size)
            noise = [torch.rand(shape, generator=s.generator("choices")) for s in streams]
            choices = draw(policy, torch.stack(noise, 1).to(task.device))  # [times, K, P]
            log_prob = policy.log_prob(choices)
        bins = choices.transpose(0, 1).flatten(1).cpu()  # [K, times * P]
        levels = task.space.generate(bins, [stream.generator("levels") for stream in streams])
        worth = self.worth(learner, levels, streams)
        paid = worth.paid.unflatten(1, shape).transpose(0, 1)
        played = TensorDict(
            {
                agent.action_key: choices,
                agent.log_prob_key: log_prob,
                "advantage": paid.unsqueeze(-1),
            },
            choices.shape,
        )
        self._learn(seen, played)
        self._told |= worth.told
        proposal = Proposal(levels, worth.frames, worth.evaluations)
        if self._choice:
            index, proposal = self._choice(learner, proposal, streams)
            bins = bins.gather(1, index)
        return bins, proposal

    def improve(self, learner: PPO, updates: int, streams: Sequence[Streams]) -> Improvement:
        """Tell of the last cycle."""
        if not self._told:
            return Improvement()
        shape = [len(values) for values in self.task.space.axes.values()]
        metrics = {**self._told, "histogram": self._proposed.view(shape).tolist()}
        self._proposed = torch.zeros_like(self._proposed)
        return Improvement(metrics)

    def learnt(self) -> dict[str, Any]:
        """The Proposer, without its optimiser."""
        return learnt_proposer(self.agent)

    def state_dict(self) -> dict[str, Any]:
        """Weights and Adam's state, and what is told of the cycle."""
        moments = {
            name: self._adam.state[parameter]
            for name, parameter in self.agent.named_parameters()
            if parameter in self._adam.state
        }
        return {
            "proposer": {
                name: {"value": parameter.detach().clone()}
                | {key: value.clone() for key, value in moments.get(name, {}).items()}
                for name, parameter in self.agent.named_parameters()
            },
            "observed": self.agent.in_keys,
            "proposed": self._proposed.clone(),
            "told": dict(self._told),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with them."""
        for name, parameter in self.agent.named_parameters():
            entry = dict(state["proposer"][name])
            parameter.data.copy_(entry.pop("value"))
            # Adam counts its steps on the CPU, whatever the device.
            self._adam.state[parameter] = {
                key: value.clone() if key == "step" else value.to(parameter.device, copy=True)
                for key, value in entry.items()
            }
        self._proposed = state["proposed"].clone()
        self._told = dict(state["told"])

    def _learn(self, seen: TensorDict, played: TensorDict) -> None:
        """A few steps on all draws: the clipped objective of each problem, with its advantage.

        Raises:
            DivergedError: if an advantage, a loss, a gradient or a weight is not finite.
        """
        steps = []
        for _ in range(self._settings.epochs):
            logits = self.agent(seen.copy())[self.agent.logits_key]  # [K, P, N]
            everywhere = logits.expand(len(played), -1, -1, -1)
            losses = self._loss(played.copy().set(self.agent.logits_key, everywhere))
            self._adam.zero_grad()
            (losses["loss_objective"] + losses["loss_entropy"]).backward()
            norm = nn.utils.clip_grad_norm_(self._parameters, self._settings.max_grad_norm)
            self._adam.step()
            terms = losses.select("loss_objective", "loss_entropy").detach()
            steps.append(terms.set("grad_norm", norm))
            with located("the Proposer"):  # before it draws from weights that are no numbers
                weights, paid = dict(self.agent.named_parameters()), played["advantage"]
                require_finite(paid.transpose(0, 1), TensorDict.stack(steps), weights, None)
        self._told |= {
            key: float(losses[key].detach()) for key in ("entropy", "kl_approx", "clip_fraction")
        }

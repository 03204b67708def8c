"""The paper's Proposer, rewarded for each problem by itself."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import ClipPPOLoss

from proposer_rl.curricula.batches import device_of
from proposer_rl.curricula.bins import along_axes, counts_of_bins
from proposer_rl.curricula.contract import Batch, Curriculum, Inbox
from proposer_rl.curricula.learnt import learnt_proposer
from proposer_rl.curricula.student import Student
from proposer_rl.learning import load_agent, located
from proposer_rl.learning.divergence import require_finite
from proposer_rl.learning.settings import PPOSettings
from proposer_rl.models import ActorCritic, draw
from proposer_rl.streams import Streams
from proposer_rl.task import Distribution, Levels, Space, refuse_single_bin


class ProblemProposer(Curriculum):
    """Draws each of P problems from a policy over probes, and learns from the reward of each.

    At every proposal the policy sees what the student would do on probe levels of the target, draws
    the bin of each problem, and is rewarded for each, standardised over all that it drew. A few
    gradient steps follow on the clipped objective of each problem (Schulman et al. 2017, eq. 7),
    with no critic. The rewards are known before anybody trains: where the levels are filtered, the
    policy learns from all that it drew.

    Args:
        space: that has the bins.
        target: the distribution through whose levels the student is seen.
        agent: from ``probes`` [K, C, ...] to logits [K, P, N] of independent categoricals, as
            :func:`~proposer_rl.models.proposer_actor_critic` makes it of a ``ProblemHead``.
        settings: of these, ``epochs``, ``learning_rate``, ``adam_eps``, ``clip_epsilon``,
            ``entropy_coeff`` and ``max_grad_norm`` count.
        probe_levels: probes C.

    Raises:
        ValueError: if the space has a single bin.
    """

    needs: tuple[str, ...] = ("probe",)
    remembers = ("_metrics", "_counts", "_inbox")

    def __init__(
        self,
        space: Space,
        target: Distribution,
        agent: ActorCritic,
        settings: PPOSettings,
        *,
        probe_levels: int = 16,
    ) -> None:
        refuse_single_bin(space)
        self.agent, self.space, self.target = agent, space, target
        self._settings, self._probe_levels = settings, probe_levels
        actor, _ = agent.readout()
        self._loss = ClipPPOLoss(
            actor,
            None,
            clip_epsilon=settings.clip_epsilon,
            entropy_coeff=settings.entropy_coeff,
            normalize_advantage=True,
            functional=False,
        ).to(device_of(target.sample(1, torch.Generator())))  # its numbers are tensors
        self._loss.set_keys(action=agent.action_key, sample_log_prob=agent.log_prob_key)
        self._parameters = [p for p in agent.parameters() if p.requires_grad]
        self._adam = torch.optim.Adam(
            self._parameters, lr=settings.learning_rate, eps=settings.adam_eps
        )
        self._inbox = Inbox()
        self._counts = torch.zeros(space.size, dtype=torch.int64)  # of levels that came back
        self._metrics: dict[str, float] = {}

    @abstractmethod
    def reward(
        self, student: Student, levels: Levels, stream: Streams
    ) -> tuple[Tensor, dict[str, float]]:
        """Of each of the levels [1, E], on which nobody has trained: float [1, E]; and metrics."""

    def propose(self, student: Student, count: int, streams: Sequence[Streams]) -> Batch:
        """Levels [1, n] of the policy's draws, from all of which it has learnt already.

        The policy draws P problems at once: as many times as it takes for n.

        Raises:
            ValueError: for several students: a Proposer learns from one.
        """
        if len(streams) != 1:
            raise ValueError(f"a Proposer learns from one Solver, got {len(streams)}")
        self._take_in()
        (stream,), agent = streams, self.agent
        probes = self.target.sample(self._probe_levels, stream.generator("probes"))
        with torch.no_grad():
            seen = TensorDict({"probes": student.probe(probes)}, [1])
            policy = agent.distribution(agent(seen.copy()))
            problems = policy.batch_shape[1]
            shape = (-(-count // problems), 1, problems)
            noise = torch.rand(shape, generator=stream.generator("choices"))
            choices = draw(policy, noise.to(seen["probes"].device))  # [times, 1, P]
            log_prob = policy.log_prob(choices)
        bins = choices.view(1, -1).cpu()  # [1, times * P]
        levels = self.space.generate(bins, [stream.generator("levels")])
        reward, metrics = self.reward(student, levels, stream)
        played = TensorDict(
            {
                agent.action_key: choices,
                agent.log_prob_key: log_prob,
                "advantage": reward.view(*choices.shape, 1),
            },
            choices.shape,
        )
        self._learn(seen, played)
        self._metrics |= metrics
        return self._numbered(levels[:, :count], bins[:, :count], stream)

    def _numbered(self, levels: Levels, bins: Tensor, stream: Streams) -> Batch:
        return self._inbox.batch(levels, bins=bins)

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Count the levels."""
        self._inbox.check(batch, outcome)
        self._counts += counts_of_bins(batch.notes["bins"], self.space)

    def log(self) -> dict[str, Any]:
        """The last metrics of the policy, and counts."""
        self._take_in()
        if not self._metrics:
            return {}
        counts, self._counts = self._counts, torch.zeros_like(self._counts)
        return {**self._metrics, "histogram": along_axes(counts, self.space)}

    def learnt(self) -> dict[str, Any]:
        """The Proposer, without its optimiser."""
        return learnt_proposer(self.agent)

    def state_dict(self) -> dict[str, Any]:
        """Weights and Adam's state, too."""
        adam = deepcopy(self._adam.state_dict())
        return super().state_dict() | learnt_proposer(self.agent) | {"adam": adam}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with them."""
        super().load_state_dict(state)
        load_agent(self.agent, TensorDict(state["proposer"]))
        self._adam.load_state_dict(deepcopy(state["adam"]))

    def _take_in(self) -> None:
        """Take in what came of the levels; here, nothing."""

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
                weights, reward = dict(self.agent.named_parameters()), played["advantage"]
                require_finite(reward.transpose(0, 1), TensorDict.stack(steps), weights, None)
        self._metrics |= {
            key: float(losses[key].detach()) for key in ("entropy", "kl_approx", "clip_fraction")
        }

"""The paper's Proposer, rewarded for each problem by itself: by first-order gain or by regret."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import ClipPPOLoss

from proposer_rl.curricula.batches import device_of
from proposer_rl.curricula.bins import along_axes, counts_of_bins
from proposer_rl.curricula.contract import Batch, Curriculum, Inbox
from proposer_rl.curricula.proposer import learnt_proposer
from proposer_rl.curricula.student import Student, TaskStudent
from proposer_rl.learning import PPOSettings, load_agent, located
from proposer_rl.learning.objective import require_finite
from proposer_rl.meta.first_order import TargetMeasure
from proposer_rl.models import ActorCritic, draw_at
from proposer_rl.settings import Count, Positive, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Distribution, Levels, Space, refuse_unfit_bins


class ProblemProposer(Curriculum):
    """Draws each of P problems from a policy, and trains it by the reward of each.

    At every proposal the policy sees what the student would do on probe levels of the target, draws
    the bin of each problem, and is rewarded for each, standardised over all that it drew. A few
    gradient steps follow on the clipped objective of each problem (Schulman et al. 2017, eq. 7).
    It has no critic.

    Args:
        space: that has the bins.
        target: the distribution of the levels through which the student is seen.
        agent: from ``probes`` [K, C, ...] to logits [K, P, N] of independent categoricals, as
            :func:`~proposer_rl.models.proposer_actor_critic` makes it of a ``ProblemHead``.
        settings: PPO's numbers, of which ``epochs``, ``learning_rate``, ``adam_eps``,
            ``clip_epsilon``, ``entropy_coeff`` and ``max_grad_norm`` count.
        probe_levels: number C of probe levels.

    Raises:
        ValueError: if the space has a single bin.
    """

    needs: tuple[str, ...] = ("probe",)
    state: ClassVar[tuple[str, ...]] = ("_metrics", "_counts", "_inbox")

    def __init__(
        self,
        space: Space,
        target: Distribution,
        agent: ActorCritic,
        settings: PPOSettings,
        *,
        probe_levels: int = 16,
    ) -> None:
        refuse_unfit_bins(space)
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
        """Returns the rewards of levels [1, E], float [1, E], and metrics."""

    def propose(self, student: Student, count: int, streams: Sequence[Streams]) -> Batch:
        """Draws levels [1, n] from the policy, which learns from them at once.

        The policy draws P at a time, and learns from all that it drew.

        Raises:
            ValueError: for several students: a Proposer learns from one.
            DivergedError: if an advantage, a loss, a gradient or a weight is not finite.
        """
        (stream,), agent = streams, self.agent
        probes = self.target.sample(self._probe_levels, stream.generator("probes"))
        with torch.no_grad():
            seen = TensorDict({"probes": student.probe(probes)}, [1])
            policy = agent.distribution(agent(seen.copy()))
            problems = policy.batch_shape[1]
            shape = (-(-count // problems), 1, problems)
            noise = torch.rand(shape, generator=stream.generator("choices"))
            choices = draw_at(policy, noise.to(seen["probes"].device))  # [times, 1, P]
            log_prob = policy.log_prob(choices)
        bins = choices.view(1, -1).cpu()  # [1, times * P]
        levels = self.space.generate(bins, [stream.generator("levels")])
        reward, metrics = self.reward(student, levels, stream)
        drawn = {
            agent.action_key: choices,
            agent.log_prob_key: log_prob,
            "advantage": reward.view(*choices.shape, 1),
        }
        self._learn(seen, TensorDict(drawn, choices.shape))
        self._metrics |= metrics
        return self._inbox.batch(levels[:, :count], bins=bins[:, :count])

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Counts the levels that came back."""
        self._inbox.check(batch, outcome)
        self._counts += counts_of_bins(batch.notes["bins"], self.space)

    def log(self) -> dict[str, Any]:
        """Returns the last metrics of the policy, and how many levels of each bin came back."""
        if not self._metrics:
            return {}
        counts, self._counts = self._counts, torch.zeros_like(self._counts)
        return {**self._metrics, "histogram": along_axes(counts, self.space)}

    def learnt(self) -> dict[str, Any]:
        """Returns the Proposer, without its optimiser."""
        return learnt_proposer(self.agent)

    def state_dict(self) -> dict[str, Any]:
        """Returns also the Proposer and Adam's state."""
        own = learnt_proposer(self.agent) | {"adam": deepcopy(self._adam.state_dict())}
        return super().state_dict() | own

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Puts back what :meth:`state_dict` returned."""
        super().load_state_dict(state)
        load_agent(self.agent, TensorDict(state["proposer"]))
        self._adam.load_state_dict(deepcopy(state["adam"]))

    def _learn(self, seen: TensorDict, played: TensorDict) -> None:
        """Makes a few gradient steps on draws [times, 1, P]."""
        steps = []
        for _ in range(self._settings.epochs):
            logits = self.agent(seen.copy())[self.agent.logits_key]  # [1, P, N]
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


class FirstOrderProposer(ProblemProposer):
    """Rewards each problem with its alignment, its first-order share of the target's gain.

    The alignment of a level is the slope of its return along the direction of the parameters that
    raises the target's performance fastest (:mod:`proposer_rl.meta.first_order`).

    Args:
        space, target, agent, settings, probe_levels: see :class:`ProblemProposer`.
        target_levels: fresh levels E of the target that the direction is taken from.
        step: of the differences that give the alignments, in learning rates.
        measure: of the target's performance; see
            :func:`~proposer_rl.meta.first_order.target_performance`.
    """

    needs = ("probe", "target_direction", "alignment")

    @checked
    def __init__(
        self,
        space: Space,
        target: Distribution,
        agent: ActorCritic,
        settings: PPOSettings,
        *,
        probe_levels: int = 16,
        target_levels: Count,
        step: Positive,
        measure: TargetMeasure,
    ) -> None:
        super().__init__(space, target, agent, settings, probe_levels=probe_levels)
        self._target_levels, self._step, self._measure = target_levels, step, measure

    def reward(
        self, student: Student, levels: Levels, stream: Streams
    ) -> tuple[Tensor, dict[str, float]]:
        """Returns the alignment of each level, by evaluations on either side of the student."""
        target = self.target.sample(self._target_levels, stream.generator("target"))
        reached, direction = student.target_direction(target.unsqueeze(0), self._measure)
        aligned = student.alignment(direction, levels, self._step)
        return aligned, {
            "target_performance": float(reached.mean()),
            "alignment": float(aligned.mean()),
            "alignment_sd": float(aligned.std(correction=0)),
        }


class PairedProposer(ProblemProposer):
    """Rewards each problem with the regret between two students.

    PAIRED (Dennis et al. 2020, arXiv 2012.02096, algorithm 1): protagonist and antagonist train on
    the same levels, and the generator of a level is rewarded

        max(0, J(antagonist, level) - J(protagonist, level)).

    J is a student's performance, which may be exact; published are the antagonist's best and the
    protagonist's mean episode. The levels are drawn from the space's bins, each rewarded by itself,
    rather than built cell by cell. The antagonist trains on a batch when all of it has come back,
    or 32 newer ones have been proposed.

    Args:
        space, target, agent, settings, probe_levels: see :class:`ProblemProposer`.
        antagonist: the second student.
    """

    needs = ("probe", "performance")

    def __init__(
        self,
        space: Space,
        target: Distribution,
        agent: ActorCritic,
        settings: PPOSettings,
        *,
        antagonist: TaskStudent,
        probe_levels: int = 16,
    ) -> None:
        super().__init__(space, target, agent, settings, probe_levels=probe_levels)
        self.antagonist = antagonist
        self._inbox = Inbox(target.sample(1, torch.Generator())[0])

    def propose(self, student: Student, count: int, streams: Sequence[Streams]) -> Batch:
        """Lets the antagonist train on the levels that came back, and draws levels [1, n].

        Raises:
            ValueError: for several students.
            DivergedError: if a number of the antagonist is not finite.
        """
        self._train_antagonist()
        batch = super().propose(student, count, streams)
        seed = streams[0].generator("antagonist").initial_seed()  # of its actions on these levels
        batch.notes["seed"] = torch.full(batch.notes.batch_size, seed)
        return batch

    def reward(
        self, student: Student, levels: Levels, stream: Streams
    ) -> tuple[Tensor, dict[str, float]]:
        """Returns the regret of each level."""
        antagonist, protagonist = (
            each.performance(levels, stream.generator("regret"))["return"]
            for each in (self.antagonist, student)
        )
        student.spend(evaluations=levels.shape[1])  # of the antagonist
        regret = (antagonist - protagonist).clamp_min(0)
        return regret, {
            "regret": float(regret.mean()),
            "regret_sd": float(regret.std(correction=0)),
        }

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Puts the levels aside for the antagonist, which takes as many steps on them."""
        super().observe(student, batch, outcome)
        student.spend(frames=int(outcome["steps"][0].sum()))
        self._inbox.put(batch, level=batch.levels, seed=batch.notes["seed"])

    def log(self) -> dict[str, Any]:
        """Returns metrics and counts, when the antagonist has trained."""
        self._train_antagonist()
        return super().log()

    def _train_antagonist(self) -> None:
        """Trains the antagonist on the batches that are complete."""
        for evidence in self._inbox.take(whole=True):
            generator = torch.Generator().manual_seed(int(evidence["seed"][0, 0]))
            self.antagonist.train(evidence["level"], [generator])

    def state_dict(self) -> dict[str, Any]:
        """Returns also the antagonist."""
        return {**super().state_dict(), "antagonist": self.antagonist.snapshot().to_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Puts back what :meth:`state_dict` returned."""
        super().load_state_dict(state)
        self.antagonist.restore(TensorDict(state["antagonist"], [1]))

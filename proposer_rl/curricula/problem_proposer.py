"""The paper's Proposer with a reward for every problem: first-order gain or regret."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from copy import deepcopy
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import ClipPPOLoss

from proposer_rl.curricula.batches import device_of, levels_in
from proposer_rl.curricula.bins import CountingCurriculum
from proposer_rl.curricula.contract import Batch
from proposer_rl.curricula.proposer import learnt_proposer
from proposer_rl.curricula.student import Student, TaskStudent
from proposer_rl.learning import PPO, PPOSettings, load_agent, located
from proposer_rl.learning.objective import require_finite
from proposer_rl.meta.first_order import TargetMeasure
from proposer_rl.models import ActorCritic, draw_at
from proposer_rl.settings import Count, Positive, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Distribution, Levels, Space, Task, refuse_unfit_bins


class ProblemProposer(CountingCurriculum):
    """Draws each of P problems from a policy, and trains the policy by the reward of each.

    At every proposal the policy sees the student's outputs on probe levels of the target, draws the
    bin of each problem, and gets a reward for each, standardised over all draws. A few gradient
    steps follow on the clipped objective of each problem (Schulman et al. 2017, eq. 7). There is no
    critic.

    Args:
        space: that has the bins.
        target: the distribution of the probe levels.
        agent: from ``probes`` [K, C, ...] to logits [K, P, N] of independent categoricals, as
            :func:`~proposer_rl.models.proposer_actor_critic` makes it of a ``ProblemHead``.
        settings: PPO's numbers, of which ``epochs``, ``learning_rate``, ``adam_eps``,
            ``clip_epsilon``, ``entropy_coeff`` and ``max_grad_norm`` count.
        probe_levels: number C of probe levels.

    Raises:
        ArgumentError: if the space has a single bin.
    """

    needs: tuple[str, ...] = ("probe",)
    state: ClassVar[tuple[str, ...]] = ("_metrics", "_counts")

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
        super().__init__(space)
        self.agent, self.target = agent, target
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
        self._metrics: dict[str, float] = {}

    @abstractmethod
    def reward(
        self, student: Student, levels: Levels, rng: Streams
    ) -> tuple[Tensor, dict[str, float]]:
        """Computes the rewards of levels [E], float [E], and metrics."""

    def propose(self, student: Student, count: int, rng: Streams) -> Batch:
        """Draws levels [n] from the policy, and trains it on them at once.

        The policy draws multiples of P levels, and learns from all of them.

        Raises:
            DivergedError: if an advantage, a loss, a gradient or a weight is not finite.
        """
        agent = self.agent
        probes = self.target.sample(self._probe_levels, rng.generator("probes"))
        with torch.no_grad():
            seen = TensorDict({"probes": student.probe(probes).unsqueeze(0)}, [1])
            policy = agent.distribution(agent(seen.copy()))
            problems = policy.batch_shape[1]
            shape = (-(-count // problems), 1, problems)
            noise = torch.rand(shape, generator=rng.generator("choices"))
            choices = draw_at(policy, noise.to(seen["probes"].device))  # [times, 1, P]
            log_prob = policy.log_prob(choices)
        bins = choices.flatten().cpu()  # [times * P]
        levels = levels_in(self.space, bins, rng.generator("levels"))
        reward, metrics = self.reward(student, levels, rng)
        drawn = {
            agent.action_key: choices,
            agent.log_prob_key: log_prob,
            "advantage": reward.view(*choices.shape, 1),
        }
        self._learn(seen, TensorDict(drawn, choices.shape))
        self._metrics |= metrics
        return Batch(levels[:count], TensorDict({"bins": bins[:count]}, [count]))

    def log(self) -> dict[str, Any]:
        """Returns the last metrics of the policy, and counts of observed levels by bin."""
        if not self._metrics:
            return {}
        return {**self._metrics, "histogram": self.histogram()}

    def learnt(self) -> dict[str, Any]:
        """Returns the Proposer without its optimiser."""
        return learnt_proposer(self.agent)

    def state_dict(self) -> dict[str, Any]:
        """Adds the Proposer and Adam's state."""
        own = learnt_proposer(self.agent) | {"adam": deepcopy(self._adam.state_dict())}
        return super().state_dict() | own

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
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
            with located("the Proposer"):  # before it draws from weights that are not finite
                weights, reward = dict(self.agent.named_parameters()), played["advantage"]
                require_finite(reward.transpose(0, 1), TensorDict.stack(steps), weights, None)
        self._metrics |= {
            key: float(losses[key].detach()) for key in ("entropy", "kl_approx", "clip_fraction")
        }


class FirstOrderProposer(ProblemProposer):
    """Rewards each problem with its alignment: its share of the target's first-order gain.

    The alignment of a level is the slope of its return along the direction of the parameters that
    raises the target's performance fastest (:mod:`proposer_rl.meta.first_order`).

    Args:
        space, target, agent, settings, probe_levels: see :class:`ProblemProposer`.
        target_levels: number E of fresh levels of the target that give the direction.
        step: of the finite differences that give the alignments, in learning rates.
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
        self, student: Student, levels: Levels, rng: Streams
    ) -> tuple[Tensor, dict[str, float]]:
        """Computes the alignment of each level from evaluations on either side of the student."""
        target = self.target.sample(self._target_levels, rng.generator("target"))
        reached, direction = student.target_direction(target, self._measure)
        aligned = student.alignment(direction, levels, self._step)
        return aligned, {
            "target_performance": float(reached),
            "alignment": float(aligned.mean()),
            "alignment_sd": float(aligned.std(correction=0)),
        }


class PairedProposer(ProblemProposer):
    """Rewards each problem with the regret between two students.

    PAIRED (Dennis et al. 2020, arXiv 2012.02096, algorithm 1): protagonist and antagonist train on
    the same levels, and the generator of a level is rewarded

        max(0, J(antagonist, level) - J(protagonist, level)).

    J is a student's performance, which may be exact; the paper uses the antagonist's best and the
    protagonist's mean episode. Levels are drawn from the space's bins, each with its own reward,
    rather than built cell by cell. The antagonist trains on the observed levels, with one update
    for as many of them as an update takes.

    Args:
        space, target, agent, settings, probe_levels: see :class:`ProblemProposer`.
        task: of the levels.
        antagonist: PPO of the second student.
    """

    state = (*ProblemProposer.state, "_levels", "_seeds")
    needs = ("probe", "performance")

    def __init__(
        self,
        space: Space,
        target: Distribution,
        agent: ActorCritic,
        settings: PPOSettings,
        *,
        task: Task,
        antagonist: PPO,
        probe_levels: int = 16,
    ) -> None:
        super().__init__(space, target, agent, settings, probe_levels=probe_levels)
        self.antagonist, self._learner = TaskStudent(task, antagonist), antagonist
        # Levels [m] on which the antagonist has yet to train, and the seeds of its actions there.
        self._levels: Levels = target.sample(1, torch.Generator())[:0]
        self._seeds: list[int] = []

    def propose(self, student: Student, count: int, rng: Streams) -> Batch:
        """Draws levels [n] from the policy, and trains it on them at once."""
        batch = super().propose(student, count, rng)
        seed = rng.generator("antagonist").initial_seed()  # of its actions on these levels
        batch.notes["seed"] = torch.full((count,), seed)
        return batch

    def reward(
        self, student: Student, levels: Levels, rng: Streams
    ) -> tuple[Tensor, dict[str, float]]:
        """Computes the regret on each level."""
        antagonist, protagonist = (
            each.performance(levels, rng.generator("regret"))["return"]
            for each in (self.antagonist, student)
        )
        student.spend(evaluations=len(levels))  # of the antagonist
        regret = (antagonist - protagonist).clamp_min(0)
        return regret, {
            "regret": float(regret.mean()),
            "regret_sd": float(regret.std(correction=0)),
        }

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Trains the antagonist on the levels that the student has trained on.

        Raises:
            DivergedError: if a number of the antagonist is not finite.
        """
        super().observe(student, batch, outcome)
        student.spend(frames=int(outcome["steps"].sum()))
        self._levels = torch.cat([self._levels, batch.levels])
        self._seeds += batch.notes["seed"].tolist()
        size = self._learner.env.batch_size[1]
        while len(self._seeds) >= size:
            levels, self._levels = self._levels[:size], self._levels[size:]
            generator = torch.Generator().manual_seed(self._seeds[0])
            del self._seeds[:size]
            self._learner.env.set_levels(levels.unsqueeze(0))
            self._learner.update([generator])
            self._learner.check()

    def state_dict(self) -> dict[str, Any]:
        """Adds the antagonist."""
        return super().state_dict() | {"antagonist": self._learner.snapshot().to_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        super().load_state_dict(state)
        self._learner.restore(TensorDict(state["antagonist"], [1]))

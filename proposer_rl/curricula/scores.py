"""How much there is to learn on a level, by what a Solver did there or by what it would do.

A score from episodes reads a rollout [K, P, T], of which only episodes count that end in it: it is
the mean over the steps of each, then the mean over the episodes of a level; minus infinity where
none ends. A score from evaluation asks the task instead, and needs no episode.

With A_t the generalised advantage, V the critic, p the probability of success, J the expected
return, J* the largest that any policy reaches, R the highest return ever seen on the level:

=====================  =============================  ====================================
score                  from episodes                  from evaluation
=====================  =============================  ====================================
positive_value_loss    mean of max(A_t, 0)
l1_value_loss          mean of abs(A_t)
max_mc                 mean of R - V(s_t)
learnability           p (1 - p) of the share p       p (1 - p)
regret                 R - mean return                J* - J
gradient_norm          the same of a policy gradient  squared norm of the gradient of J
=====================  =============================  ====================================

Sources: value losses: Jiang et al. 2021 (arXiv 2010.03934, section 3.1; 2110.02439, section 5);
MaxMC: the latter, appendix; learnability: Rutherford et al. 2024 (arXiv 2408.15099, section 4);
regret: Dennis et al. 2020 (arXiv 2012.02096); gradient norm: PACE (arXiv 2605.01358). The critic is
discounted and R is not, so that ``max_mc`` is biased even at the optimum.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor

from proposer_rl.curricula.checks import one_of, whole
from proposer_rl.learning import PPO, succeeded
from proposer_rl.learning.advantages import gae
from proposer_rl.meta.gradient_norms import squared_gradients, squared_policy_gradients
from proposer_rl.streams import Streams
from proposer_rl.task import DifferentiableTask, ExactTask, Levels, OptimalTask, Task

Source = Literal["episodes", "exact"]

AT_ONCE = 1024  # levels of each Solver that are evaluated at once


class Episodes(NamedTuple):
    """The episodes of a rollout [K, P, T] that end in it.

    Attributes:
        weight: of every step, float64 [K, P, T]: 1 / (steps of its episode), so that those of an
            episode add up to 1; 0 for steps of an episode that does not end.
        ended: episodes of each level, int64 [K, P].
        successes: those of them that were a success, int64 [K, P].
        total: sum of their undiscounted returns, float64 [K, P].
        best: the highest of these, float64 [K, P]; minus infinity without episodes.
    """

    weight: Tensor
    ended: Tensor
    successes: Tensor
    total: Tensor
    best: Tensor


def episodes(rollout: TensorDictBase) -> Episodes:
    """Split a rollout [K, P, T] into its episodes."""
    after = rollout["next"]
    done, reward = (after[key].squeeze(-1) for key in ("done", "reward"))
    ends, reward = done.long(), reward.double()
    count = ends.sum(-1)
    number = ends.cumsum(-1) - ends  # of the episode that a step belongs to
    none = torch.zeros_like(reward)
    steps = none.scatter_add(-1, number, torch.ones_like(reward))
    returns = none.scatter_add(-1, number, reward)
    exists = torch.arange(reward.shape[-1], device=reward.device) < count.unsqueeze(-1)
    return Episodes(
        weight=(1 / steps.gather(-1, number)).where(number < count.unsqueeze(-1), 0.0),
        ended=count,
        successes=(succeeded(rollout) & done).sum(-1),
        total=returns.where(exists, 0.0).sum(-1),
        best=returns.where(exists, -torch.inf).amax(-1),
    )


def positive_value_loss(advantage: Tensor, value: Tensor, best: Tensor) -> Tensor:
    """max(A, 0) of every step [K, P, T]: where the Solver does better than it thought."""
    return advantage.clamp_min(0)


def l1_value_loss(advantage: Tensor, value: Tensor, best: Tensor) -> Tensor:
    """abs(A) of every step [K, P, T]."""
    return advantage.abs()


def max_mc(advantage: Tensor, value: Tensor, best: Tensor) -> Tensor:
    """R - V of every step [K, P, T], with the highest return R [K, P] ever seen on the level."""
    return best.unsqueeze(-1) - value


STEPWISE = {f.__name__: f for f in (positive_value_loss, l1_value_loss, max_mc)}


class Scored(NamedTuple):
    """Levels' scores float64 [K, P], and the highest returns seen, float32 [K, P]."""

    score: Tensor
    best: Tensor


class Scorer:
    """One of the scores, from one of its sources.

    Args:
        task: whose levels are scored.
        name: of the score; see the table above.
        source: whether it is read off episodes or asked of the task.
        rollouts: played on each level that is scored without training on it, from episodes.

    Attributes:
        from_episodes: whether :meth:`play` scores levels, else :meth:`ask`.

    Raises:
        TypeError: if the task lacks what the score needs.
        ValueError: if there is no such score, or not from this source.
    """

    def __init__(self, task: Task, name: str, source: Source, rollouts: int = 1) -> None:
        self.task = task
        self.rollouts = whole("rollouts", rollouts, 1)
        self.from_episodes = one_of("source", source, ("episodes", "exact")) == "episodes"
        self._name = name
        there_are = {
            "episodes": [*STEPWISE, "learnability", "regret", "gradient_norm"],
            "exact": ["learnability", "regret", "gradient_norm"],
        }
        if name not in there_are[source]:
            raise ValueError(f"score={name!r}: from source={source} there are {there_are[source]}")
        if not self.from_episodes:
            self._exact = _exact_score(task, name)
        elif name == "gradient_norm":
            self._policy_gradients = squared_policy_gradients(task)

    def of_rollouts(self, learner: PPO, rollouts: Sequence[TensorDictBase], best: Tensor) -> Scored:
        """Score levels [K, P] by rollouts on them, [K, P, T] each.

        Args:
            learner: whose critic and discount count.
            rollouts: with values, as :meth:`PPO.collect` returns them.
            best: the highest returns seen on these levels before, float [K, P]; minus infinity
                where there was none.
        """
        found = [episodes(rollout) for rollout in rollouts]
        count = torch.stack([f.ended for f in found]).sum(0)
        some = count.clamp(1)
        best = torch.stack([best.to(count.device).double(), *(f.best for f in found)]).amax(0)
        if self._name == "gradient_norm":
            lengths = [
                self._policy_gradients(learner, rollout, _advantages(learner, rollout))
                for rollout in rollouts
            ]
            score = torch.stack(lengths).mean(0)
        elif self._name in STEPWISE:
            each = [
                (self._stepwise(learner, rollout, best) * f.weight).sum(-1)
                for rollout, f in zip(rollouts, found, strict=True)
            ]
            score = torch.stack(each).sum(0) / some
        elif self._name == "regret":
            score = best - torch.stack([f.total for f in found]).sum(0) / some
        else:
            share = torch.stack([f.successes for f in found]).sum(0) / some
            score = share * (1 - share)
        return Scored(score.double().where(count > 0, -torch.inf).cpu(), best.float().cpu())

    def play(
        self, learner: PPO, levels: Levels, streams: Sequence[Streams], *purpose: str | int
    ) -> tuple[Scored, int]:
        """Score levels [K, n] that nobody trains on, n a multiple of P, by playing on them.

        Args:
            learner: the Solvers.
            levels: of each.
            streams: of the present update.
            purpose: below which actions are drawn.

        Returns:
            The scores, and the frames that they cost each Solver.
        """
        scored, frames = [], 0
        device = learner.env.device
        for batch, some in enumerate(levels.split(self.task.batch_size, 1)):
            played = []
            for again in range(self.rollouts):
                learner.env.set_levels(some)
                place = (*purpose, batch, again)
                draws = [s.generator("score", *place, device=device) for s in streams]
                played.append(learner.collect(draws))
                frames += played[-1][0].numel()
            scored.append(
                self.of_rollouts(learner, played, torch.full(some.batch_size, -torch.inf))
            )
        return Scored(*(torch.cat(entries, 1) for entries in zip(*scored, strict=True))), frames

    @torch.no_grad()
    def ask(
        self, learner: PPO, levels: Levels, streams: Sequence[Streams], *purpose: str | int
    ) -> tuple[Scored, int]:
        """Score levels [K, n] by what the task says of them.

        Args:
            learner: the Solvers.
            levels: of each.
            streams: of the present update.
            purpose: below which is drawn what a task's performance draws at random.

        Returns:
            The scores, and the evaluations that they cost each Solver.
        """
        found = []
        for batch, some in enumerate(levels.split(AT_ONCE, 1)):
            generator = streams[0].generator("score", *purpose, batch, device=self.task.device)
            found.append(self._exact(learner, some, generator).double().cpu())
        score = torch.cat(found, 1)
        return Scored(score, torch.full(score.shape, -torch.inf)), score.shape[1]

    def _stepwise(self, learner: PPO, rollout: TensorDictBase, best: Tensor) -> Tensor:
        values = rollout[learner.agent.value_key].squeeze(-1).double()
        return STEPWISE[self._name](_advantages(learner, rollout).double(), values, best)


def _advantages(learner: PPO, rollout: TensorDictBase) -> Tensor:
    """GAE with the learner's numbers, not standardised: float [K, P, T]."""
    settings = learner.settings
    estimate = gae(settings.gamma, settings.lmbda, learner.agent.value_key)
    return estimate(rollout.copy())["advantage"].squeeze(-1)


def _exact_score(task: Task, name: str) -> Callable[[PPO, Levels, torch.Generator], Tensor]:
    """Asks the task; gives float [K, n] for levels [K, n]."""
    if name == "gradient_norm":
        if not isinstance(task, DifferentiableTask):
            raise TypeError(
                f"score=gradient_norm needs gradients: {type(task).__name__} must define "
                "differentiable_performance(agent, levels)"
            )
        norms = squared_gradients(cast(ExactTask, task))
        return lambda learner, levels, _: norms(learner, levels)
    if name == "regret" and not isinstance(task, OptimalTask):
        raise TypeError(
            f"{type(task).__name__} does not know the largest return (optimal_return), which "
            "score=regret from source=exact needs; source=episodes takes the best that was seen"
        )
    if not task.exact_performance:
        raise ValueError(
            f"source=exact: {type(task).__name__} tells performance by playing, which is not "
            "exact; give source=episodes, as +score=sampled does"
        )
    if name == "learnability":

        def learnability(learner: PPO, levels: Levels, generator: torch.Generator) -> Tensor:
            success = task.performance(learner.agent, levels, generator)["success"]
            return success * (1 - success)

        return learnability
    optimum = cast(OptimalTask, task).optimal_return
    return lambda learner, levels, generator: (
        optimum(levels) - task.performance(learner.agent, levels, generator)["return"]
    )

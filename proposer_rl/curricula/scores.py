"""How much there is to learn on a level, by what a Solver did there or by what it would do.

A score from episodes reads a rollout [K, P, T], of which only episodes count that end in it: it is
the mean over the steps of each, then the mean over the episodes of a level; minus infinity where
none ends (``gradient_norm``: over all steps). A score from evaluation asks the task instead, and
needs no episode.

With A_t the generalised advantage, delta_t the error of one step, V the critic, p the probability
of success, J the expected return, J* the largest that any policy reaches, and R the highest return
ever seen on the level, or from evaluation the expected highest of as many episodes as ``rollouts``:

=======================  =============================  ====================================
score                    from episodes                  from evaluation
=======================  =============================  ====================================
positive_value_loss      mean of max(A_t, 0)
l1_value_loss            mean of abs(A_t)
mean_negative_advantage  mean of A_t's losses alone;
                         0 if never solved
one_step_td_error        mean of abs(delta_t)           its expectation
max_mc                   mean of R - V(s_t)             its expectation
learnability             p (1 - p) of the share p       p (1 - p)
return_variance          that of the returns            that of the return
regret                   R - mean return                J* - J
gradient_norm            the same of a policy gradient  squared norm of the gradient of J
=======================  =============================  ====================================

Sources: learnability: Rutherford et al. 2024 (arXiv 2408.15099, section 4), variance of a return
that is 0 or 1; regret: Dennis et al. 2020 (arXiv 2012.02096); gradient norm: PACE (arXiv
2605.01358); the first five: :mod:`~proposer_rl.curricula.stepwise`. The critic is discounted and R
is not, so that ``max_mc`` is biased even at the optimum.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from proposer_rl.curricula.checks import one_of, whole
from proposer_rl.curricula.exact_scores import EXACT, exact_score
from proposer_rl.curricula.stepwise import STEPWISE, advantages
from proposer_rl.learning import PPO, succeeded
from proposer_rl.meta.gradient_norms import squared_policy_gradients
from proposer_rl.streams import Streams
from proposer_rl.task import Levels, Task

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
        squares: sum of the squares of these, float64 [K, P].
        best: the highest of these, float64 [K, P]; minus infinity without episodes.
    """

    weight: Tensor
    ended: Tensor
    successes: Tensor
    total: Tensor
    squares: Tensor
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
        squares=returns.square().where(exists, 0.0).sum(-1),
        best=returns.where(exists, -torch.inf).amax(-1),
    )


class Scored(NamedTuple):
    """Levels' scores, and what was ever seen there.

    Attributes:
        score: float64 [K, P].
        best: the highest return, float32 [K, P]; minus infinity where no episode was seen.
        solved: whether there was a success, bool [K, P].
    """

    score: Tensor
    best: Tensor
    solved: Tensor


def unseen(shape: Sequence[int]) -> tuple[Tensor, Tensor]:
    """The highest return on levels that nobody has played yet, and whether one was solved."""
    return torch.full(shape, -torch.inf), torch.zeros(shape, dtype=torch.bool)


class Scorer:
    """One of the scores, from one of its sources.

    Args:
        task: whose levels are scored.
        name: of the score; see the table above.
        source: whether it is read off episodes or asked of the task.
        rollouts: played on each level that is scored without training on it, from episodes;
            from evaluation, the episodes of which ``max_mc`` takes the expected highest return.

    Attributes:
        from_episodes: whether levels are scored by playing on them.

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
            "episodes": [*STEPWISE, "learnability", "return_variance", "regret", "gradient_norm"],
            "exact": list(EXACT),
        }
        if name not in there_are[source]:
            raise ValueError(f"score={name!r}: from source={source} there are {there_are[source]}")
        if not self.from_episodes:
            self._exact = exact_score(task, name, self.rollouts)
        elif name == "gradient_norm":
            self._policy_gradients = squared_policy_gradients(task)

    def of_rollouts(
        self, learner: PPO, rollouts: Sequence[TensorDictBase], best: Tensor, solved: Tensor
    ) -> Scored:
        """Score levels [K, P] by rollouts on them, [K, P, T] each.

        Args:
            learner: whose critic and discount count.
            rollouts: with values, as :meth:`PPO.collect` returns them.
            best: the highest returns seen on these levels before, float [K, P]; minus infinity
                where there was none.
            solved: whether an episode was a success before, bool [K, P].
        """
        found = [episodes(rollout) for rollout in rollouts]
        _, *numbers = zip(*found, strict=True)  # weights may be of several lengths
        ended, successes, total, squares, highest = map(torch.stack, numbers)
        count, some = ended.sum(0), ended.sum(0).clamp(1)
        best = torch.maximum(best.to(count.device).double(), highest.amax(0))
        solved = solved.to(count.device) | (successes.sum(0) > 0)
        mean = total.sum(0) / some
        if self._name == "gradient_norm":
            lengths = [
                self._policy_gradients(learner, rollout, advantages(learner, rollout).float())
                for rollout in rollouts
            ]
            score = torch.stack(lengths).mean(0)
        elif self._name in STEPWISE:
            step_score = STEPWISE[self._name]
            each = [
                (step_score(learner, rollout, best) * f.weight).sum(-1)
                for rollout, f in zip(rollouts, found, strict=True)
            ]
            score = torch.stack(each).sum(0) / some
            if self._name == "mean_negative_advantage":
                score = score.where(solved, 0.0)
        elif self._name == "regret":
            score = best - mean
        elif self._name == "return_variance":
            score = (squares.sum(0) / some - mean.square()).clamp_min(0)
        else:
            share = successes.sum(0) / some
            score = share * (1 - share)
        score = score.double().where(count > 0, -torch.inf)
        return Scored(score.cpu(), best.float().cpu(), solved.cpu())

    def __call__(
        self, learner: PPO, levels: Levels, streams: Sequence[Streams], *purpose: str | int
    ) -> tuple[Scored, int, int]:
        """Score levels [K, n] that nobody trains on; from episodes n is a multiple of P.

        Args:
            learner: the Solvers.
            levels: of each.
            streams: of the present update.
            purpose: below which is drawn what actions, or a task's performance, draw at random.

        Returns:
            The scores, and the frames and evaluations that they cost each Solver.
        """
        if self.from_episodes:
            return *self._play(learner, levels, streams, *purpose), 0
        scored = self._ask(learner, levels, streams, *purpose)
        return scored, 0, levels.shape[1]

    def _play(
        self, learner: PPO, levels: Levels, streams: Sequence[Streams], *purpose: str | int
    ) -> tuple[Scored, int]:
        scored, frames = [], 0
        for batch, some in enumerate(levels.split(self.task.batch_size, 1)):
            played = []
            for again in range(self.rollouts):
                learner.env.set_levels(some)
                draws = [s.generator("score", *purpose, batch, again) for s in streams]
                played.append(learner.collect(draws))
                frames += played[-1][0].numel()
            scored.append(self.of_rollouts(learner, played, *unseen(some.batch_size)))
        return Scored(*(torch.cat(entries, 1) for entries in zip(*scored, strict=True))), frames

    @torch.no_grad()
    def _ask(
        self, learner: PPO, levels: Levels, streams: Sequence[Streams], *purpose: str | int
    ) -> Scored:
        found = []
        for batch, some in enumerate(levels.split(AT_ONCE, 1)):
            generator = streams[0].generator("score", *purpose, batch)
            found.append(self._exact(learner, some, generator).double().cpu())
        score = torch.cat(found, 1)
        return Scored(score, *unseen(score.shape))

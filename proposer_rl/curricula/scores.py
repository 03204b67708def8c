"""Scores levels by how much a student can learn there, from episodes or by evaluation.

A score from episodes reads a rollout [n, T]. Only episodes that end within it count: the score is
the mean over the steps of each, then over the episodes of a level, and minus infinity if none ends
(``gradient_norm``: over all steps). A score from evaluation asks the student instead, and needs no
episodes.

With V the critic, gamma the discount and lambda the decay of the traces,

    delta_t = r_t + gamma V(s_(t+1)) - V(s_t),    V = 0 where the episode terminated,

the error of one step, A_t the generalised advantage, that is the sum of
(gamma lambda)^i delta_(t+i), p the probability of success, J the expected return, J* the highest
expected return of any policy, and R the highest return ever seen on the level:

=======================  =============================  ====================================
score                    from episodes                  from evaluation
=======================  =============================  ====================================
positive_value_loss      mean of max(A_t, 0)
l1_value_loss            mean of abs(A_t)
max_mc                   mean of R - V(s_t)
learnability             p (1 - p) of the share p       p (1 - p)
regret                   R - mean return                J* - J
gradient_norm            squared norm of a policy       squared norm of the gradient of J
                         gradient
=======================  =============================  ====================================

You can also score outcomes by a function of your own; see :class:`Scorer`.

If a loop reports outcomes without rollouts, an episode counts as one step, and the previous return
on the level (for a new level the mean of these over the buffer) takes the place of the critic.
Value losses are then absolute learning progress (Portelas et al. 2019, arXiv 1910.07224), and only
``gradient_norm`` is unavailable. A score that the loop reports itself replaces all of this.

Sources: value losses: Jiang et al. 2021 (arXiv 2010.03934, section 3.1; 2110.02439, section 5);
MaxMC: the latter, appendix; learnability: Rutherford et al. 2024 (arXiv 2408.15099, section 4),
variance of a return that is 0 or 1; regret: Dennis et al. 2020 (arXiv 2012.02096); gradient norm:
PACE (arXiv 2605.01358). The critic is discounted and R is not, so that ``max_mc`` is biased even at
the optimum.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from pkgutil import resolve_name
from typing import Any, Literal, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula.contract import outcome_of
from proposer_rl.curricula.student import Student, advantages, values
from proposer_rl.learning import succeeded
from proposer_rl.settings import ArgumentError, Count, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Levels, NoSuccessError

Source = Literal["episodes", "exact"]

OwnScore = Callable[[Student, TensorDictBase], Tensor]
"""A function of your own that scores the outcomes of levels [n]: float [n].

Called with the student, which has the ``gamma`` and ``lmbda`` of its critic, and the outcome; see
:func:`~proposer_rl.curricula.outcome_of`. A higher score means more to learn; minus infinity
means no score.
"""

ASKS = {"gradient_norm": ("policy_gradient_norms",)}  # of a student, from episodes
READS = {"learnability": ("success",), "yield": ("success",), "gradient_norm": ("rollout",)}
AT_ONCE = 1024  # levels that are evaluated at once

STEPWISE: dict[str, Callable[[Student, TensorDictBase, Tensor], Tensor]] = {
    "positive_value_loss": lambda student, rollout, _: advantages(student, rollout).clamp_min(0),
    "l1_value_loss": lambda student, rollout, _: advantages(student, rollout).abs(),
    "max_mc": lambda _, rollout, best: best.unsqueeze(-1) - values(rollout).squeeze(-1).double(),
}
"""Scores of every single step of a rollout [n, T], float64 and of that shape.

The last argument is R, the highest return ever seen on each level, [n].
"""


def learnability(student: Student, levels: Levels) -> Tensor:
    """Returns p (1 - p) of the probability p of success, float [n].

    Raises:
        NoSuccessError: if there is no success.
    """
    performance = student.exact_performance(levels)
    if "success" not in performance.keys():
        raise NoSuccessError(
            "learnability: this task tells no success, only the return; the scores regret and "
            "gradient_norm need only that"
        )
    success = performance["success"]
    return success * (1 - success)


EXACT: dict[str, tuple[tuple[str, ...], Callable[[Student, Levels], Tensor]]] = {
    "learnability": (("exact_performance",), learnability),
    "regret": (
        ("optimal_return", "exact_performance"),
        lambda s, levels: s.optimal_return(levels) - s.exact_performance(levels)["return"],
    ),
    "gradient_norm": (("gradient_norms",), lambda s, levels: s.gradient_norms(levels)),
}
"""For each score the functions of a student that it needs, and its formula: float [n]."""


class Episodes(NamedTuple):
    """The episodes that end within a rollout [n, T].

    Attributes:
        weight: of every step, float64 [n, T]: 1 / (steps of its episode), so that the weights of an
            episode add up to 1; 0 for steps of an episode that does not end.
        ended: number of episodes on each level, int64 [n].
        successes: number of those that were a success, int64 [n].
        total: sum of their undiscounted returns, float64 [n].
        best: the highest of these, float64 [n]; minus infinity without episodes.
    """

    weight: Tensor
    ended: Tensor
    successes: Tensor
    total: Tensor
    best: Tensor


def episodes(rollout: TensorDictBase) -> Episodes:
    """Splits a rollout [n, T] into its episodes."""
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


class Scored(NamedTuple):
    """Scores of levels, and the highest returns ever seen on them.

    Attributes:
        score: float64 [n].
        best: the highest return, float32 [n]; minus infinity where no episode was seen.
    """

    score: Tensor
    best: Tensor


def unseen(count: int) -> Tensor:
    """Returns the highest returns of levels [n] that nobody has played: minus infinity."""
    return torch.full((count,), -torch.inf)


class Scorer:
    """Scores levels by one of the scores above, or by a function of your own.

    Args:
        score: its name in the table above; or, from episodes, an :data:`OwnScore` or the dotted
            name of one, ``my_module.my_score``.
        source: whether the score comes from episodes or from an evaluation of the student.
        rollouts: number of rollouts on each level that is scored without training on it.

    Attributes:
        from_episodes: whether the score comes from episodes.
        needs: functions of a student that it calls to score levels without training on them.
        asks: functions of a student that it calls to score levels that were trained on.
        required_results: entries of an outcome that it needs besides the return.
        plays_for: those of them that playing on levels has to provide.

    Raises:
        ArgumentError: if there is no such score, or not from this source.
    """

    plays_for: tuple[str, ...] = ()

    @checked
    def __init__(self, score: str | OwnScore, source: Source, rollouts: Count = 1) -> None:
        self.rollouts, self.from_episodes = rollouts, source == "episodes"
        self._warned = False
        self._own = _own_score(score)
        own = getattr(score, "__qualname__", type(score).__name__)
        self._name = name = score if isinstance(score, str) else own
        available = [*STEPWISE, *READS, "regret"] if self.from_episodes else [*EXACT]
        if self._own is None and name not in available:
            more = ", and functions of your own, as my_module.my_score" * self.from_episodes
            raise ArgumentError(f"score={name!r}: from source={source} there are {available}{more}")
        if self._own is not None and not self.from_episodes:
            raise ArgumentError(f"score={name}: a function of your own needs source=episodes")
        if self.from_episodes:
            self.asks: tuple[str, ...] = ASKS.get(name, ())
            self.required_results: tuple[str, ...] = READS.get(name, ())
            self.needs: tuple[str, ...] = ("play", *self.asks)
        else:
            self.asks, self.required_results = EXACT[name][0], ()
            self.needs = self.asks
        self.plays_for = tuple(entry for entry in self.required_results if entry != "rollout")

    def of_outcome(
        self, student: Student, outcome: TensorDictBase, best: Tensor, before: Tensor
    ) -> Scored:
        """Scores levels [n] by the outcome of training on them.

        Args:
            student: provides critic and discount.
            outcome: with a ``score``, a ``rollout``, or neither.
            best: see :meth:`of_rollouts`.
            before: the previous return on each level, float [n]; minus infinity if unknown.
        """
        if self._own is not None:
            reached = outcome["return"].float().cpu()
            scored = Scored(self._by_own(student, outcome), torch.maximum(best, reached))
        elif "rollout" in outcome.keys():
            scored = self.of_rollouts(student, [outcome["rollout"]], best)
        else:
            told = {name: entry.cpu() for name, entry in outcome.items()}
            self._look_at(told.get("episodes", torch.ones(1)))
            scored = _of_returns(self._name, told, best, before)
        if "score" in outcome.keys():
            scored = scored._replace(score=outcome["score"].double().cpu())
        return scored

    def of_rollouts(
        self, student: Student, rollouts: Sequence[TensorDictBase], best: Tensor
    ) -> Scored:
        """Scores levels [n] by rollouts on them, [n, T] each.

        Args:
            student: provides critic and discount.
            rollouts: with values, as ``Student.play`` returns them.
            best: the highest returns seen on these levels so far, float [n]; minus infinity for
                none.
        """
        split = [episodes(rollout) for rollout in rollouts]
        _, *numbers = zip(*split, strict=True)  # weights may be of several lengths
        ended, successes, total, highest = map(torch.stack, numbers)
        count, some = ended.sum(0), ended.sum(0).clamp(1)
        best = torch.maximum(best.to(count.device).double(), highest.amax(0))
        mean = total.sum(0) / some
        if self._name == "gradient_norm":
            lengths = [student.policy_gradient_norms(rollout) for rollout in rollouts]
            score = torch.stack(lengths).mean(0)
        elif self._name in STEPWISE:
            step_score = STEPWISE[self._name]
            each = [
                (step_score(student, rollout, best) * own.weight).sum(-1)
                for rollout, own in zip(rollouts, split, strict=True)
            ]
            score = torch.stack(each).sum(0) / some
        elif self._name == "regret":
            score = best - mean
        else:
            self._look_at(count)
            share = successes.sum(0) / some
            score = mixed(share, some) if self._name == "yield" else share * (1 - share)
        score = score.double().where(count > 0, -torch.inf)
        return Scored(score.cpu(), best.float().cpu())

    def __call__(
        self,
        student: Student,
        levels: Levels,
        rng: Streams,
        *purpose: str | int,
        before: Tensor | None = None,
    ) -> Scored:
        """Scores levels [n] without training on them; the student counts the cost.

        Args:
            student: that would be trained.
            levels: to be scored.
            rng: of the present proposal.
            purpose: below which is drawn what actions draw at random.
            before: see :meth:`of_outcome`; None where nothing is known.
        """
        size = (student.batch_size if self.from_episodes else AT_ONCE) or len(levels)
        known = (unseen(len(levels)) if before is None else before).split(size)
        scored = []
        for batch, some in enumerate(levels.split(size)):
            if self.from_episodes:
                played = [
                    student.play(some, rng.generator("score", *purpose, batch, again))
                    for again in range(self.rollouts)
                ]
                scored.append(self._of_played(student, played, known[batch]))
            else:
                _, ask = EXACT[self._name]
                with torch.no_grad():
                    score = ask(student, some).double().cpu()
                scored.append(Scored(score, unseen(len(score))))
        return Scored(*(torch.cat(entries) for entries in zip(*scored, strict=True)))

    def _of_played(
        self, student: Student, played: Sequence[TensorDictBase], before: Tensor
    ) -> Scored:
        """Scores levels [n] by rollouts or outcomes on them; see :meth:`__call__`."""
        none, rollouts = unseen(len(before)), "next" in played[0].keys()
        if self._own is not None:
            outcomes = map(outcome_of, played) if rollouts else played
            each = [self.of_outcome(student, outcome, none, before) for outcome in outcomes]
            score, best = (torch.stack(entries) for entries in zip(*each, strict=True))
            return Scored(score.mean(0), best.amax(0))
        if rollouts:
            return self.of_rollouts(student, played, none)
        told: Any = torch.stack([*played]).cpu()  # [rollouts, n]
        mean = {name: e.mean(0) for name, e in told.items() if e.is_floating_point()}
        mean["episodes"] = told.get("episodes", torch.ones(told.shape)).sum(0)
        outcome, best = TensorDict(mean, told.shape[1:]), told["return"].amax(0)
        return self.of_outcome(student, outcome, best, before)

    def _look_at(self, answers: Tensor) -> None:
        """Warns once if the yield is taken of single answers, which are never mixed."""
        if self._name == "yield" and not self._warned and single(answers):
            self._warned = True
            warnings.warn(
                "score=yield: is always 0 of a single answer; tell episodes= of several, or use "
                "learnability",
                stacklevel=2,
            )

    def _by_own(self, student: Student, outcome: TensorDictBase) -> Tensor:
        """Scores an outcome [n] by a function of your own: float64 [n]."""
        assert self._own is not None
        score, shape = self._own(student, outcome), outcome.batch_size
        if not isinstance(score, Tensor) or score.shape != shape or bool(score.isnan().any()):
            raise ValueError(f"score={self._name}: must return a tensor {list(shape)} without NaN")
        ended = outcome.get("episodes", torch.ones(shape)).cpu() > 0
        return score.double().cpu().where(ended, -torch.inf)


def mixed(p: Tensor, answers: Tensor | float) -> Tensor:
    """Returns the probability that the answers to an item are not all alike.

    Args:
        p: probability of a right one.
        answers: number G of them.

    Example:
        >>> mixed(torch.tensor([0.0, 0.5, 0.9]), 2.0)
        tensor([0.0000, 0.5000, 0.1800])
    """
    return 1 - p**answers - (1 - p) ** answers


def single(answers: Tensor) -> bool:
    """Returns whether there are groups of one answer, and none of several."""
    return bool((answers == 1).any()) and not bool((answers > 1).any())


def _own_score(score: str | OwnScore) -> OwnScore | None:
    """Finds a function of your own, given or named with dots; None for a built-in score."""
    if not isinstance(score, str):
        return score
    if "." not in score:
        return None
    try:
        found: OwnScore = resolve_name(score)
    except (ImportError, AttributeError, ValueError) as error:
        raise ArgumentError(f"score={score}: {error}") from error
    return found


def _of_returns(name: str, outcome: Mapping[str, Tensor], best: Tensor, before: Tensor) -> Scored:
    """Scores levels [n] by returns and success alone; see the description above."""
    reached = outcome["return"].double()
    success = outcome.get("success", torch.zeros_like(reached)).double()
    value = before.double().where(before.isfinite(), reached)
    best = torch.maximum(best.double(), reached)
    gained = reached - value
    score = {
        "positive_value_loss": gained.clamp_min(0),
        "l1_value_loss": gained.abs(),
        "max_mc": best - value,
        "regret": best - reached,
        "learnability": success * (1 - success),
        "yield": mixed(success, outcome.get("episodes", torch.ones_like(success))),
    }[name]
    return Scored(score, best.float())

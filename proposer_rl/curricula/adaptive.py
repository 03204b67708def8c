"""A mixture of the target, uniform sampling and a bridge between them, by what is seen of each.

Every batch has three arms: levels of the **target** itself; **uniform** ones of the whole space;
and the **bridge**: levels that a belief holds for mastered, as near to the target as there are.
With b the success on the target lately, their shares are

    t = low + (HIGH - low) b / (b + HALF),      w = (1 - t) q,      u = (1 - t) (1 - q).

The target gets more the more often it is solved: there training pays most. While it is never
solved, ``low`` lies between FLOOR, where its episodes alone all return the same and teach nothing,
and LOW, where they differ at least half as much as all episodes do. Of what is left the bridge gets
a part q that grows with the skill of the belief, the correlation of what it predicted and what came
on uniform levels: the bridge needs to know which levels are easier, and a student that improves is
ahead of any forecast of how often it succeeds. Uniform sampling is never given up, as beliefs may
be wrong; with little skill it leads. b is the largest that was seen, which fades with the half-life
LATER, so that a target that is forgotten while others are trained on is not left alone.

For the bridge, each of some draws of the target gets the candidate of its own that is nearest to it
among those whose expected success is at least ``delta``, by optimal assignment with squared
distances, less a bonus for learnability, 4 p (1 - p). Where too few are expected to succeed so
often, the best take their place. Candidates are new levels of the space and levels between those
of the last batch's bridge and the target, where the space knows what lies between two levels: the
interpolation of Klink et al. 2022, "Curriculum Reinforcement Learning via Constrained Optimal
Transport" (ICML), with particles in place of bins, and no pace but what is mastered.

Where failures all return the same and uniform levels are seldom solved, most episodes teach
nothing. With u the success on uniform levels lately, and d how dense rewards are, the standard
deviation of the returns of failures over that of all returns, in units of DENSE and at most 1,

    c = clamp((OFTEN - u) / (OFTEN - SELDOM), 0, 1) (1 - d of uniform levels).

c moves the bridge's part q to MOST and ``low`` to LEAST. Where levels do not come back one by one,
it also moves the bridge's candidates to MANY times as many, and ``delta`` to MASTERED; where they
do, there are few near to the target, and such a bridge would stay on the easy ones. The target's
share rises later where rewards are sparse: HALF becomes HALF d + SPARSE_HALF (1 - d), with the
larger d of levels of the target and of uniform ones. All of this needs success that is told.

A data set has items that come back, and nothing between two of them. Nothing is concentrated
there. As no levels can be made, there are more candidates, all different, and learnability counts
for more; and their success is drawn from the posterior, so that items of which little or nothing
new is known are tried again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Annotated, Any

import torch
from annotated_types import Ge
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn import functional as F

from proposer_rl.curricula.batches import finite, levels_in
from proposer_rl.curricula.belief import Belief
from proposer_rl.curricula.contract import Batch, Curriculum
from proposer_rl.curricula.outcome_model import Predictions
from proposer_rl.curricula.student import Student
from proposer_rl.meta.assembly import Components
from proposer_rl.settings import Count, Share, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Distribution, Levels, Space, level_inputs

Inputs = Callable[[Levels], Tensor]
"""Maps levels [*B] to the inputs of a belief: float [*B, D], each about -1 to 1."""

RESULTS = ("return", "success")
ARMS = ("target", "uniform", "bridge")
TARGET, UNIFORM, BRIDGE = range(3)
SUMS = (
    *("levels", "successes", "labels", "squared labels"),
    *("predicted", "squared predicted", "products"),
    *("returns", "squared returns"),
    *("failures", "failed", "squared failed"),  # of which the last two are returns
)
FLOOR, LOW, HIGH = 0.1, 0.25, 0.9  # of the share of the target
# b at half of the distance from low to HIGH; without successes
HALF, HALF_OF_RETURNS = 0.1, 0.5
# part q: with no skill it is that in the middle
BRIDGE_LEAST, BRIDGE_AT_ONCE, BRIDGE_MOST = 0.2, 0.4, 0.8
# Success on uniform levels up to which the bridge is concentrated, and from which on it is not; the
# ratio of deviations from which on rewards are dense; and what is moved to where they are sparse.
SELDOM, OFTEN, DENSE = 0.2, 0.4, 0.25
MOST, MANY, MASTERED, LEAST, SPARSE_HALF = 0.95, 16, 0.5, 0.05, 0.4
SOON, LATER = 6.0, 20.0  # half-lives in batches: of sums, and of b where success falls again
# Added to the sums of squares of predictions and labels that a correlation is of: a few say little.
UNSURE = 0.05, 0.5
FEW = 16  # levels, of which fewer are counted as a part of a batch
RARE = 0.02  # share of successes, below which the belief learns from returns, too
LEARNABLE = 0.2  # of the bonus, in squared distances per input
ITEMS_LEARNABLE, ITEMS_TIMES = 1.0, 4  # that, and times as many candidates, of a data set
NEAR = 0.025  # standard deviation of what is added between two levels, in shares of a range
# Levels of the bridge that are assigned to draws of the target together. The time of an assignment
# grows faster than with the square: of 288, it is 10 ms in blocks of 64, 30 of 128, 150 at once.
# Of more than LARGE, blocks are half as large, which takes a third of the time.
AT_ONCE, LARGE = 64, 512
MOST_LEVELS = 3072  # candidates of a batch, where more are wanted where it is concentrated
FORBIDDEN = 1e3  # cost of a candidate that is not mastered
FAILURES = 4.0  # on the target, that are taken for seen at the beginning
OUTLIERS, MOST_OUTLIERS = 1000, 63  # one in so many returns at either end; and at most
EQUAL = 1e-9  # returns that differ no more than this are equal, in units of the largest


class AdaptiveMixture(Curriculum):
    """Mixes the target, uniform sampling and a bridge between them by what was seen of each.

    See the module for the equations. Labels are successes where they are told; else returns, as
    shares of the range from the lowest to the highest that was seen, less one in a thousand at
    either end, so that an episode that went wrong does not make all others look alike. It asks
    nothing of a student, so that it costs no frames and no oracle.

    Args:
        space: where levels come from. ``between(a, b, noise, generator)`` gives levels between two,
            ``items(levels)`` the numbers of levels that come back one by one, ``expected`` log odds
            of success of each, float64 [N], before anything is seen.
        target: what is to be mastered; None where all levels of the space count: then there are
            the uniform arm and the bridge alone, whose levels are learnable ones near to uniform
            ones.
        inputs: what the belief knows of levels; None for what the space says, see
            :func:`~proposer_rl.task.level_inputs`.
        delta: least expected success of a level of the bridge.
        half_life: batches after which the belief counts an outcome half.
        times: candidates for each level of the bridge.
    """

    optional_results = ("success",)
    state = (
        "_came",
        "_sums",
        "_best",
        "_ends",
        "_number",
        "_told",
        "_seen",
        "_shown",
        "_belief",
        "_last",
    )

    @checked
    def __init__(
        self,
        space: Space,
        target: Distribution | None = None,
        inputs: Inputs | None = None,
        *,
        delta: Share = 0.3,
        half_life: Annotated[float, Ge(1)] = 12.0,
        times: Count = 4,
    ) -> None:
        self._space, self._target = space, target
        # A data set has items, and nothing between two of them.
        self._is_data = hasattr(space, "items") and not hasattr(space, "between")
        self._known = inputs or partial(level_inputs, space)
        self._delta, self._half_life, self._times = delta, half_life, times
        one = space.sample(1, torch.Generator())
        items = 0 if self._items(one) is None else space.size
        self._come_back = items > 0
        expected = getattr(space, "expected", None)
        width = self._known(one).shape[-1]
        self._belief = Belief(width, items, expected=expected, half_life=half_life)
        self._sums = torch.zeros(len(ARMS), len(SUMS), dtype=torch.float64)
        self._best = torch.zeros((), dtype=torch.float64)  # success on the target, b
        # The lowest returns and the negatives of the highest [2, m], of how many levels.
        self._ends, self._number = torch.zeros(2, 0, dtype=torch.float64), 0
        self._told = False  # whether success is told
        self._concentration = 0.0  # c, of the next batch
        self._last: Levels = one[:0]  # of the bridge, [m]
        self._came: list[dict[str, Any]] = []  # what the next proposal learns from
        self._seen = Predictions()
        self._shown: dict[str, Any] = {}

    @classmethod
    def create(cls, run: Components, **settings: Any) -> AdaptiveMixture:
        """Makes it for a run's space, and its target and inputs if it has any."""
        return cls(run.task.space, run.optional("target"), run.optional("inputs"), **settings)

    def propose(self, student: Student, count: int, rng: Streams) -> Batch:
        """Returns levels [n] of the three arms, in a random order."""
        came, self._came = self._came, []
        for seen, batches in together(came):
            self._learn(seen, batches)
        levels, arms = self._batch(count, self._shares(), rng.generator("levels"))
        inputs, items = self._inputs(levels), self._items(levels)
        notes = {"arm": arms, "inputs": inputs, "predicted": self._belief.predict(inputs, items)}
        if items is not None:
            notes["items"] = items
        return Batch(levels, TensorDict(notes, [count]))

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Keeps what came of levels, which the next proposal learns from."""
        seen: dict[str, Any] = {name: outcome[name] for name in RESULTS if name in outcome.keys()}
        if "episodes" in outcome.keys() and "rollout" not in outcome.keys():
            seen["counts"] = outcome["episodes"]  # that the means are of
        seen = {name: entry.double().cpu() for name, entry in seen.items()}
        self._came.append({**batch.notes.to_dict(), **seen, "size": batch.size})

    def log(self) -> dict[str, Any]:
        """Returns the shares and what they follow from, and how right the belief was.

        ``shares`` of the arms, ``target_success``, b, ``target_signal``, how much returns on the
        target differ in units of all, ``skill`` of the belief, ``concentration``, c; and as
        :func:`~proposer_rl.curricula.outcome_model.calibration`.
        """
        shown, self._shown = self._shown, {}
        return shown | self._seen.log()

    def _learn(self, seen: Mapping[str, Any], batches: float) -> None:
        """Learns from what came of levels, with which batches, or a part of one, have passed."""
        returns, predicted = seen["return"], seen["predicted"]
        success, labels = self._labels(returns, seen.get("success"))
        self._belief.grow_older(batches)
        self._belief.observe(seen["inputs"], labels, seen.get("items"), seen.get("counts"))
        self._seen.add(predicted, success)
        of = {
            "levels": torch.ones_like(labels),
            "successes": success,
            "labels": labels,
            "squared labels": labels.square(),
            "predicted": predicted,
            "squared predicted": predicted.square(),
            "products": predicted * labels,
            "returns": returns,
            "squared returns": returns.square(),
            "failures": 1 - success,
            "failed": (1 - success) * returns,
            "squared failed": (1 - success) * returns.square(),
        }
        rows = torch.stack([of[name] for name in SUMS], -1)
        arms = F.one_hot(seen["arm"], len(ARMS)).double().mT
        self._sums = 0.5 ** (batches / SOON) * self._sums + arms @ rows
        tried, won = self._sums[TARGET, :2]
        faded = 0.5 ** (batches / LATER) * self._best
        self._best = torch.maximum(faded, won / (tried + FAILURES))

    def _labels(self, returns: Tensor, success: Tensor | None) -> tuple[Tensor, Tensor]:
        """Returns what counts as success on levels, and what the belief learns, float64 [m]."""
        self._number += len(returns)
        ends = torch.cat([self._ends, torch.stack([returns, -returns])], -1)
        kept = min(MOST_OUTLIERS + 1, ends.shape[-1])
        self._ends = ends = ends.topk(kept, largest=False).values
        place = min(self._number // OUTLIERS, MOST_OUTLIERS)
        low, high = ends[0, place], -ends[1, place]
        wide = high - low > EQUAL * torch.maximum(high.abs(), low.abs())
        grades = torch.where(wide, (returns - low) / (high - low), 0.5).clamp(0, 1)
        self._told = self._told or success is not None
        if success is None:
            return grades, grades
        tried, won = self._sums[:, :2].sum(0)
        rare = won + success.sum() < RARE * (tried + len(success))
        return success, torch.maximum(success, grades / 2) if rare else success

    def _shares(self) -> Tensor:
        """Returns the shares of the arms in the next batch, float64 [3]."""
        sums = dict(zip(SUMS, self._sums.unbind(-1), strict=True))

        def variance(name: str, of: Callable[[Tensor], Tensor], number: str = "levels") -> Tensor:
            """Returns the variance of what was summed up, of some arms: []."""
            count, total, squares = (of(sums[n]) for n in (number, name, f"squared {name}"))
            square = squares / count
            found = square - (total / count).square()
            return found.where(found > EQUAL * square, 0.0)

        every = variance("returns", lambda one: one.sum())

        def dense(arm: int) -> Tensor:
            """Returns d of an arm: 0 where all failures on it return the same, 1 where dense."""
            ratio = (variance("failed", lambda one: one[arm], "failures") / every).sqrt()
            return (ratio.nan_to_num(0.0, posinf=1.0) / DENSE).clamp(max=1)

        own = variance("returns", lambda one: one[TARGET])
        signal = (own / every).sqrt()
        signal = signal.nan_to_num(1.0, posinf=1.0).clamp(max=1)  # before anything is seen
        number, came, expected, products, solved = (
            sums[name][UNIFORM]
            for name in ("levels", "labels", "predicted", "products", "successes")
        )
        squares = [
            number * variance(name, lambda one: one[UNIFORM]) + unsure
            for name, unsure in zip(("predicted", "labels"), UNSURE, strict=True)
        ]
        covered = products - expected * came / number
        skill = (covered / (squares[0] * squares[1]).sqrt()).nan_to_num(0.0)
        low = FLOOR + (LOW - FLOOR) * (2 * signal).clamp(max=1)
        half = torch.tensor(HALF if self._told else HALF_OF_RETURNS, dtype=torch.float64)
        bridge = (BRIDGE_AT_ONCE + skill / 2).clamp(BRIDGE_LEAST, BRIDGE_MOST)
        if self._told and not self._is_data:
            everywhere = dense(UNIFORM)
            half = SPARSE_HALF + (half - SPARSE_HALF) * torch.maximum(dense(TARGET), everywhere)
            seldom = ((OFTEN - solved / number) / (OFTEN - SELDOM)).clamp(0, 1)
            c = (seldom * (1 - everywhere)).nan_to_num(0.0)
            low, bridge = low + c * (LEAST - low), bridge + c * (MOST - bridge)
            self._concentration = float(c)
        target = low + (HIGH - low) * self._best / (self._best + half)
        if self._target is None:
            target = torch.zeros_like(target)
        shares = torch.stack([target, (1 - target) * (1 - bridge), (1 - target) * bridge], -1)
        self._shown |= {
            "shares": dict(zip(ARMS, shares.tolist(), strict=True)),
            "target_success": float(self._best),
            "target_signal": float(signal),
            "skill": float(skill),
            "concentration": self._concentration,
        }
        return shares

    def _batch(self, count: int, shares: Tensor, draw: torch.Generator) -> tuple[Levels, Tensor]:
        """Returns levels [n] in a random order, and their arms."""
        arms = allotted(shares, count, draw)
        target, uniform, bridge = torch.bincount(arms, minlength=len(ARMS)).tolist()
        parts = [self._space.sample(uniform, draw)]
        if target and self._target is not None:
            parts = [self._target.sample(target, draw), *parts]
        if bridge:
            parts.append(self._bridge(bridge, draw))
        order = torch.randperm(count, generator=draw)
        return torch.cat(parts)[order], arms[order]

    def _bridge(self, count: int, draw: torch.Generator) -> Levels:
        """Returns levels [n] that are mastered, and near to the target."""
        goal = self._space if self._target is None else self._target
        targets = goal.sample(count, draw)
        times = self._times * (ITEMS_TIMES if self._is_data else 1)
        c = 0.0 if self._come_back else self._concentration
        times = max(times, min(round(times * MANY**c), MOST_LEVELS // count))
        levels = self._candidates(times * count, targets, draw)
        goals, x, items = self._inputs(targets), self._inputs(levels), self._items(levels)
        # Items are explored by draws, which differ where little is known, or nothing new.
        if items is None or not self._is_data:
            p = self._belief.predict(x, items)
        else:
            p = self._belief.draw(x, items, draw)
        delta = self._delta + c * max(MASTERED - self._delta, 0)
        allowed = p >= p.topk(count).values[-1].clamp(max=delta)
        bonus = ITEMS_LEARNABLE if self._is_data else LEARNABLE
        extra = torch.where(allowed, -bonus * 4 * p * (1 - p), FORBIDDEN)
        most, start = AT_ONCE if count <= LARGE else AT_ONCE // 2, 0
        chosen = []
        while start < count:
            size = min(most, count - start)
            number = min(LARGE, count - start) // size  # of blocks whose costs are taken together
            few = slice(times * start, times * (start + number * size))
            every = x[few].view(number, times * size, x.shape[1])
            some = goals[start : start + number * size].view(number, size, x.shape[1])
            far = torch.cdist(some, every).square_().div_(max(x.shape[1], 1))
            for costs in far.add_(extra[few].view(number, 1, -1)):
                block = slice(times * start, times * (start + size))
                able = allowed[block].nonzero().flatten()
                # The others would be left over, and an assignment among few takes less time.
                able = able if len(able) >= size else torch.arange(times * size)
                chosen.append(block.start + able[assigned(costs[:, able])])
                start += size
        self._last = levels[torch.cat(chosen)]
        return self._last

    def _candidates(self, count: int, targets: Levels, draw: torch.Generator) -> Levels:
        """Returns levels [n] of the space and, if it can, between the last bridge and targets."""
        space: Any = self._space
        if self._is_data:  # none twice, where there are enough
            order = torch.randperm(space.size, generator=draw)
            places = order.repeat(-(-count // space.size))[:count]
            return levels_in(space, places, draw)
        if not hasattr(space, "between"):
            return space.sample(count, draw)
        half = count // 2
        fresh = space.sample(count - half, draw)
        last = self._last if len(self._last) else fresh
        a = last[torch.randint(len(last), (half,), generator=draw)]
        b = targets[torch.randint(len(targets), (half,), generator=draw)]
        every = torch.cat([fresh, space.between(a, b, NEAR, draw)])
        return every[torch.randperm(count, generator=draw)]

    def _inputs(self, levels: Levels) -> Tensor:
        return finite("inputs", self._known(levels))

    def _items(self, levels: Levels) -> Tensor | None:
        space: Any = self._space
        return space.items(levels) if hasattr(space, "items") else None


def together(parts: Sequence[dict[str, Any]]) -> list[tuple[dict[str, Any], float]]:
    """Returns parts of batches [m] as they are learned from, and the batches that pass by each.

    Parts of more than LARGE levels are joined, with others of one kind, up to a batch.
    """
    joined: list[tuple[dict[str, Any], float]] = []
    for one in parts:
        part = dict(one)
        size = part.pop("size")
        share = len(part["return"]) / max(size, FEW)
        if size > LARGE and joined:
            last, passed = joined[-1]
            if passed + share <= 1 and last.keys() == part.keys():
                part = {name: torch.cat([last[name], entry]) for name, entry in part.items()}
                share += passed
                joined.pop()
        joined.append((part, share))
    return joined


def assigned(costs: Tensor) -> Tensor:
    """Returns a candidate for each goal, none twice, at the least sum of costs.

    Args:
        costs: float64 [G, C], C at least G.

    Returns:
        int64 [G].

    Example:
        >>> assigned(torch.tensor([[1.0, 2.0, 9.0], [1.0, 5.0, 9.0]]))
        tensor([1, 0])
    """
    # SciPy's solvers take long to import, and few curricula need them.
    from scipy.optimize import linear_sum_assignment

    return torch.from_numpy(linear_sum_assignment(costs.numpy())[1])


def allotted(shares: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Returns the arms of levels, int64 [n], in rising order: as many of each as its share is.

    What is left of a level is drawn, so that on average numbers are as the shares.

    Args:
        shares: that add up to one, float64 [arms].
        count: number n of levels.
        generator: of the CPU.
    """
    start = torch.rand(1, generator=generator, dtype=torch.float64)
    arms = torch.searchsorted(shares.cumsum(0) * count, start + torch.arange(count), right=True)
    return arms.clamp(max=len(shares) - 1)

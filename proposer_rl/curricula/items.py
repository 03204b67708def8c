"""Curricula of items such as prompts, which come back, by how many of G answers were right.

Each draws items of a data set, or bins of another space, and keeps a few numbers about each item.
An item has the probability p of a right answer; m of its G answers were right. The success of its
outcome is m / G, and its ``episodes`` are G; where answers are graded, m is the sum of the grades.
A group of answers teaches only if they are not all alike, which has the probability
1 - p^G - (1 - p)^G.

These curricula have no floor of exploration: an item that seems out of reach is hardly drawn again.
:class:`~proposer_rl.curricula.AdaptiveMixture` has such a floor.
"""

from __future__ import annotations

import math
import warnings
from abc import abstractmethod
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula.batches import levels_in
from proposer_rl.curricula.contract import Batch, Curriculum
from proposer_rl.curricula.outcome_model import Predictions
from proposer_rl.curricula.scores import mixed, single
from proposer_rl.curricula.student import Student
from proposer_rl.meta.actions import systematic_draw
from proposer_rl.settings import ArgumentError, Decay, Positive, Share, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Space, refuse_unfit_bins

PRIOR = math.pi**2 / 16 - 0.5  # variance of the arc length of a probability that is uniform


class ItemCurriculum(Curriculum):
    """Draws items by numbers that it keeps about each and updates by the answers.

    A subclass defines the first numbers, the draws, and how to learn.

    Args:
        space: of N items, or with N bins.
    """

    required_results = ("success",)
    state: ClassVar[tuple[str, ...]] = ("_came", "numbers", "_seen")

    def __init__(self, space: Space) -> None:
        refuse_unfit_bins(space)
        self.space = space
        self.numbers: dict[str, Tensor] = {}  # none before the first proposal
        self._came: list[dict[str, Tensor]] = []  # from which the next proposal learns
        self._seen = Predictions()

    @abstractmethod
    def first_numbers(self) -> dict[str, Tensor]:
        """Returns the numbers about items before any answer, by name."""

    @abstractmethod
    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Draws the places of items, int64 [n].

        Args:
            count: number n of items, perhaps more than there are.
            generator: of the CPU.
        """

    @abstractmethod
    def learn(self, seen: dict[str, Tensor]) -> None:
        """Updates the numbers, in place, by the answers to a batch.

        Args:
            seen: ``item``, places int64 [m], ``success`` and ``count`` of answers, float64 [m].
        """

    def expected(self) -> Tensor | None:
        """Returns the expected success on each item, float64 [N]; None if there is no estimate."""
        return None

    def propose(self, student: Student, count: int, rng: Streams) -> Batch:
        """Returns items [n], each at most once if there are enough."""
        self.numbers = self.numbers or self.first_numbers()
        came, self._came = self._came, []
        for seen in came:
            self.learn(seen)
            if "predicted" in seen:
                self._seen.add(seen["predicted"], seen["success"])
        places = self.draw(count, rng.generator("choices"))
        notes = {"item": places}
        if (guesses := self.expected()) is not None:
            notes["predicted"] = guesses[places]
        levels = levels_in(self.space, places, rng.generator("levels"))
        return Batch(levels, TensorDict(notes, [count]))

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Keeps the outcome of items until the next proposal, which learns from it."""
        success = outcome["success"].double().cpu()
        counts = torch.ones_like(success)
        if "rollout" not in outcome.keys():  # whose success is that of its first episode
            counts = outcome.get("episodes", counts).double().cpu()
        self._came.append({**batch.notes.to_dict(), "success": success, "count": counts})

    def log(self) -> dict[str, Any]:
        """Returns how accurate the expectations were, if there are any."""
        return self._seen.log()


class BetaSampling(ItemCurriculum):
    """MoPPS: draws each item's success from a Beta distribution; takes those nearest to an aim.

    Qu et al. 2025 (arXiv 2507.04632). For an item that was answered,

        a <- decay a + (1 - decay) + m,    b <- decay b + (1 - decay) + G - m,

    with a = b = 1 at first. The items whose draws from Beta(a, b) are nearest to ``aim`` come next.

    Args:
        space: see :class:`ItemCurriculum`.
        decay: share of the old counts that an observation keeps.
        aim: wanted success.
    """

    @checked
    def __init__(self, space: Space, *, decay: Share = 0.5, aim: Share = 0.5) -> None:
        super().__init__(space)
        self._decay, self._aim = decay, aim

    def first_numbers(self) -> dict[str, Tensor]:
        """Returns a and b, float64 [N]."""
        one = torch.ones(self.space.size, dtype=torch.float64)
        return {"a": one, "b": one.clone()}

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Draws the items nearest to the aim."""
        # The public torch.distributions takes no generator.
        a, b = (
            torch._standard_gamma(self.numbers[name], generator=generator) for name in ("a", "b")
        )
        return nearest(a / (a + b) - self._aim, count, generator)

    def learn(self, seen: dict[str, Tensor]) -> None:
        """Updates the Beta distributions of the items that were answered."""
        items, answers, right = per_item(seen)
        for name, number in (("a", right), ("b", answers - right)):
            own = self.numbers[name]
            own[items] = self._decay * own[items] + 1 - self._decay + number

    def expected(self) -> Tensor:
        """Returns a / (a + b)."""
        return self.numbers["a"] / (self.numbers["a"] + self.numbers["b"])


class AdaptiveDifficulty(ItemCurriculum):
    """AdaRFT: draws the items nearest to a difficulty that follows the mean success.

    Shi et al. 2025 (arXiv 2504.05520). The difficulty of an item is 1 minus its pass rate. With r
    the mean success of a batch, the wanted difficulty T changes by

        T <- T + step tanh(sensitivity (r - aim)),

    clipped to the difficulties of the items. It starts at the lowest.

    Args:
        space: of items with a pass rate each.
        step: largest change of T.
        sensitivity: of T to the mean success.
        aim: wanted success.

    Raises:
        ArgumentError: if an item has no pass rate.
    """

    @checked
    def __init__(
        self, space: Space, *, step: Positive = 0.5, sensitivity: Positive = 2.0, aim: Share = 0.5
    ) -> None:
        super().__init__(space)
        rates: Tensor | None = getattr(space, "pass_rates", None)
        if rates is None or rates.isnan().any():
            found = "none" if rates is None else f"{int(rates.isnan().sum())} missing"
            raise ArgumentError(f"pass_rates: {found}: this curriculum needs one of each item")
        self._difficulty = 1 - rates
        self._step, self._sensitivity, self._aim = step, sensitivity, aim

    def first_numbers(self) -> dict[str, Tensor]:
        """Returns the difficulty T, float64 [1]."""
        return {"difficulty": self._difficulty.min().repeat(1)}

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Draws the items nearest to T."""
        return nearest(self._difficulty - self.numbers["difficulty"], count, generator)

    def learn(self, seen: dict[str, Tensor]) -> None:
        """Moves T by the mean success of the batch."""
        reward = (seen["success"] * seen["count"]).sum() / seen["count"].sum()
        moved = self._step * (self._sensitivity * (reward - self._aim)).tanh()
        low, high = self._difficulty.min(), self._difficulty.max()
        self.numbers["difficulty"].add_(moved).clamp_(low, high)

    def log(self) -> dict[str, Any]:
        """Returns T."""
        return {name: float(each) for name, each in self.numbers.items()}


class CategoryBandit(ItemCurriculum):
    """SEC: draws categories by a learnt value of each, and items of a category uniformly.

    Chen et al. 2025 (arXiv 2505.14970). The shares of categories are softmax(Q / temperature). With
    r the mean absolute advantage of the answers in a category, TD(0) updates its value by

        Q <- (1 - rate) Q + rate r,    0 at first.

    If advantages are divided by the deviation in their group, r is 2 sqrt(p (1 - p)) for a group
    with a share p of successes. Groups need several answers.

    Args:
        space: of items with ``categories``.
        rate: of learning.
        temperature: of the shares.

    Raises:
        ArgumentError: if items have no categories.
    """

    @checked
    def __init__(self, space: Space, *, rate: Share = 0.5, temperature: Positive = 0.4) -> None:
        super().__init__(space)
        categories: Tensor | None = getattr(space, "categories", None)
        if categories is None:
            raise ArgumentError(
                "features: have no texts: this curriculum needs a category of each item"
            )
        self._categories, self._warned = categories, False
        self._rate, self._temperature = rate, temperature

    def first_numbers(self) -> dict[str, Tensor]:
        """Returns the values Q, float64 [C]."""
        size = int(self._categories.max()) + 1
        return {"value": torch.zeros(size, dtype=torch.float64)}

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Draws categories systematically, and items of each without replacement."""
        shares = (self.numbers["value"] / self._temperature).softmax(0)
        drawn = systematic_draw(shares[None], count, [generator])[0]
        places = torch.empty_like(drawn)
        for category in drawn.unique():
            members = (self._categories == category).nonzero().flatten()
            these = drawn == category
            order = nearest(torch.zeros(len(members)), int(these.sum()), generator)
            places[these] = members[order]
        return places

    def learn(self, seen: dict[str, Tensor]) -> None:
        """Updates the values of the categories that were drawn."""
        category, p = self._categories[seen["item"]], seen["success"]
        zero = torch.zeros_like(self.numbers["value"])
        number = zero.index_add(0, category, torch.ones_like(p))
        spread = 2 * (p * (1 - p)).sqrt()
        if not self._warned and single(seen["count"]) and not spread.any():
            self._warned = True
            warnings.warn(
                "sec: a single answer has no advantage, so all categories stay alike; tell "
                "episodes= of several",
                stacklevel=2,
            )
        reward = zero.index_add(0, category, spread) / number.clamp(min=1)
        self.numbers["value"].lerp_(reward, self._rate * (number > 0).double())

    def log(self) -> dict[str, Any]:
        """Returns the values of the categories."""
        return {name: each.tolist() for name, each in self.numbers.items()}


class ArcLengthFilter(ItemCurriculum):
    """Tracks each item's arc length, psi = arcsin(sqrt(p)), and draws those near a wanted one.

    After ARCUS (arXiv 2609.38018). The estimate z of an arc length from m of G answers has the
    variance 1 / (4 G + 2) for any p, or 1 / (2 G) if all or none were right; see
    :func:`arc_length`. A Kalman filter for each item follows its estimates. All items share one
    drift per batch, which is filtered as well. Items are drawn without replacement in proportion to

        (overlap of N(psi, variance) with N(wanted, width^2)) (1 - p^G - (1 - p)^G),

    where wanted belongs to the lowest p at which a group is mixed with at least 1 - ``slack`` of
    the highest probability.

    Args:
        space: see :class:`ItemCurriculum`.
        noise: variance that an item's arc length gains per batch.
        drift_noise: variance that the drift gains per batch.
        width: standard deviation around the wanted arc length.
        slack: share of the mixed groups to give up for harder items.
    """

    @checked
    def __init__(
        self,
        space: Space,
        *,
        noise: Share = 1e-4,
        drift_noise: Share = 1e-6,
        width: Positive = 0.15,
        slack: Decay = 0.1,
    ) -> None:
        super().__init__(space)
        self._noise, self._drift_noise = noise, drift_noise
        self._width, self._slack = width, slack

    def first_numbers(self) -> dict[str, Tensor]:
        """Returns arc lengths and their variances [N], the drift and its variance, and G."""
        shape = (self.space.size,)
        one = torch.ones(1, dtype=torch.float64)
        return {
            "psi": torch.full(shape, math.pi / 4, dtype=torch.float64),
            "variance": torch.full(shape, PRIOR, dtype=torch.float64),
            "drift": 0 * one,
            "drift_variance": self._drift_noise * one,
            "answers": 2 * one,
        }

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Draws items without replacement, in proportion to their scores."""
        own = self.numbers
        wanted = wanted_arc(float(own["answers"]), self._slack)
        spread = own["variance"] + self._width**2
        overlap = -(own["psi"] - wanted).square() / (2 * spread) - spread.log() / 2
        score = overlap + mixed(self.expected(), own["answers"]).clamp(min=1e-9).log()
        waits = torch.empty_like(score).exponential_(generator=generator)
        return nearest(waits.log() - score, count, generator, smallest=True)

    def learn(self, seen: dict[str, Tensor]) -> None:
        """Moves all arc lengths by the drift, and those of answered items by their answers."""
        own = self.numbers
        items, answers, right = per_item(seen)
        own["psi"].add_(own["drift"]).clamp_(0, math.pi / 2)
        own["variance"].add_(self._noise).clamp_(max=PRIOR)
        z, error = arc_length(right, answers)
        off, both = z - own["psi"][items], own["variance"][items] + error
        gain = own["variance"][items] / both
        own["psi"][items] += gain * off
        own["variance"][items] *= 1 - gain
        own["drift_variance"].add_(self._drift_noise)
        weight = (1 / both).sum()
        part = own["drift_variance"] / (own["drift_variance"] + 1 / weight)
        own["drift"].add_(part * (off / both).sum() / weight)
        own["drift_variance"].mul_(1 - part)
        own["answers"].fill_(max(float(answers.mean()), 2.0))

    def expected(self) -> Tensor:
        """Returns the expectation of sin^2 of the arc lengths."""
        own = self.numbers
        return (1 - (-2 * own["variance"]).exp() * (2 * own["psi"]).cos()) / 2


def per_item(seen: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Sums a batch by item: the items, int64 [m], their answers and their right answers."""
    items, row = seen["item"].unique(return_inverse=True)
    none = torch.zeros(len(items), dtype=torch.float64)
    answers = none.index_add(0, row, seen["count"])
    return items, answers, none.index_add(0, row, seen["count"] * seen["success"])


def nearest(
    distances: Tensor, count: int, generator: torch.Generator, smallest: bool = False
) -> Tensor:
    """Returns the places of the smallest distances in random order, int64 [n].

    Ties are broken at random. Each place occurs once, or, if n exceeds N, about equally often.

    Args:
        distances: float [N].
        count: number n of places.
        generator: of the CPU.
        smallest: whether signs count; otherwise absolute values are compared.
    """
    mixed_up = torch.randperm(len(distances), generator=generator)
    keys = distances[mixed_up] if smallest else distances[mixed_up].abs()
    rounds, rest = divmod(count, len(keys))
    places = mixed_up[keys.argsort(stable=True)[:rest]]
    places = torch.cat([*([mixed_up] * rounds), places])
    return places[torch.randperm(count, generator=generator)]


def arc_length(right: Tensor, answers: Tensor) -> tuple[Tensor, Tensor]:
    """Estimates an arc length and its variance from m right answers out of G.

    Args:
        right: m, float64 [n].
        answers: G, float64 [n].
    """
    all_alike = (right <= 0) | (right >= answers)
    inner = ((right + 0.375) / (answers + 0.75)).clamp(0, 1).sqrt().asin()
    ends = (right > 0).double() * math.pi / 2
    error = torch.where(all_alike, 1 / (2 * answers), 1 / (4 * answers + 2))
    return torch.where(all_alike, ends, inner), error


def wanted_arc(answers: float, slack: float) -> float:
    """Returns the arc length of the lowest p whose groups are mixed nearly as often as at 1/2."""
    p = torch.linspace(0, 0.5, 1001, dtype=torch.float64)
    often = mixed(p, answers)
    enough = often >= (1 - slack) * often[-1] - 1e-12
    return float(p[enough][0].sqrt().asin())

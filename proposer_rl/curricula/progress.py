"""Learning progress: trains on the bins in which performance changes fastest."""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor

from proposer_rl.curricula.bins import BinCurriculum, Measure, Probes, means_of_bins
from proposer_rl.curricula.student import Student
from proposer_rl.settings import Count, Decay, Share, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Space

Q = 0.1  # the success that is stretched to one half


class LearningProgressCurriculum(BinCurriculum):
    """Draws batches from bins by their bidirectional learning progress.

    With p the student's success in a bin at a scoring pass, f and s a fast and a slow average of it
    and g the function :func:`stretched`,

        f <- fast f + (1 - fast) p,    s <- slow s + (1 - slow) f,    LP = |g(f) - g(s)|,
        share of a bin = (1 - exploration) LP / (sum of all LP) + exploration / N,

    and uniform shares where there is no progress at all. Both averages begin with the first p
    (Kanitscheider et al. 2021, arXiv 2106.14876, section on learning progress; Zhang et al. 2023,
    OMNI, arXiv 2306.01711).

    Args:
        space: that has the bins.
        every: number of batches between two scoring passes.
        source: of p: ``"exact"`` evaluates fixed levels of every bin, which costs evaluations and
            is exact if the task's performance is; ``"episodes"`` uses the results of training since
            the last scoring pass, which costs nothing, and keeps the averages of bins without any.
        probes: number of levels of each bin.
        measure: ``"success"``; or ``"return"`` for tasks without success, in which case g, a
            function of probabilities, is left out.
        fast, slow: share of the old value in each average.
        exploration: uniform part of each batch.
    """

    shown = ("score", "performance")
    state = (*BinCurriculum.state, "_episodes", "_probes")

    @checked
    def __init__(
        self,
        space: Space,
        *,
        every: Count = 1,
        source: Literal["exact", "episodes"] = "exact",
        probes: Count = 16,
        measure: Measure = "success",
        fast: Decay = 0.9,
        slow: Decay = 0.9,
        exploration: Share = 0.2,
    ) -> None:
        super().__init__(space, every=every)
        self.needs = ("performance",) if source == "exact" else ()
        self.required_results = ("success",) if (source, measure) == ("episodes", "success") else ()
        probed = probes if source == "exact" else 0
        self._source, self._probes = source, Probes(space, probed, measure)
        self._fast, self._slow, self._exploration = fast, slow, exploration
        # Sum and number of the results in each bin since the last scoring pass, [N].
        self._episodes: list[Tensor] = []

    def score(self, student: Student, count: int, rng: Streams) -> None:
        """Updates the averages by the performance on the probes, or by recent episodes."""
        seen = torch.full((self.space.size,), torch.nan)  # where nothing was
        if self._source == "exact":
            seen = self._probes.performance(student, rng)
        elif self._episodes:
            seen = self._episodes[0] / self._episodes[1]
        self._episodes = []
        unknown = torch.full_like(seen, torch.nan)
        fast, slow = (self.scores.get(name, unknown) for name in ("fast", "slow"))
        new_fast = torch.where(fast.isnan(), seen, fast.lerp(seen, 1 - self._fast))
        new_slow = torch.where(slow.isnan(), new_fast, slow.lerp(new_fast, 1 - self._slow))
        fast, slow = (
            torch.where(seen.isnan(), old, new) for old, new in ((fast, new_fast), (slow, new_slow))
        )
        shown = stretched if self._probes.measure == "success" else torch.Tensor.clone
        progress = (shown(fast) - shown(slow)).abs()
        self.scores = {
            "score": progress.nan_to_num(0.0),
            "performance": fast.nan_to_num(0.0),
            "fast": fast,
            "slow": slow,
        }

    def learn(self, bins: Tensor, outcome: TensorDictBase) -> None:
        """Adds the results of episodes to the sums of their bins, if progress comes from them."""
        if self._source == "exact":
            return
        reached = outcome[self._probes.measure].float().cpu()
        means, counts = means_of_bins(bins, reached, self.space.size)
        totals = [(means * counts).nan_to_num(0.0), counts]
        before = self._episodes or [torch.zeros_like(total) for total in totals]
        self._episodes = [one + other for one, other in zip(before, totals, strict=True)]

    def shares(self) -> Tensor:
        """Returns the shares of the bins in the next batch, float [N]."""
        return progress_shares(self.scores["score"], self._exploration)


def stretched(success: Tensor, q: float = Q) -> Tensor:
    """Returns p (1 - q) / (p + q (1 - 2 p)) of success p, which gives small p more weight.

    Kanitscheider et al. 2021 (arXiv 2106.14876), with q = 0.1: a success of q is stretched to one
    half, 0 and 1 stay.

    Args:
        success: probabilities, float [*B].
        q: above 0, below 1.

    Example:
        >>> stretched(torch.tensor([0.0, 0.1, 0.5, 1.0]))
        tensor([0.0000, 0.5000, 0.9000, 1.0000])
    """
    return success * (1 - q) / (success + q * (1 - 2 * success))


def progress_shares(progress: Tensor, exploration: float) -> Tensor:
    """Returns shares [*B, N] in proportion to progress [*B, N], with a uniform part.

    Args:
        progress: not negative.
        exploration: the part that is uniform; all of it for a student without any progress.

    Example:
        >>> progress_shares(torch.tensor([[3.0, 1.0], [0.0, 0.0]]), 0.2)
        tensor([[0.7000, 0.3000],
                [0.5000, 0.5000]])
    """
    total = progress.sum(-1, keepdim=True)
    even = torch.full_like(progress, 1 / progress.shape[-1])
    greedy = torch.where(total > 0, progress / total, even)
    return (1 - exploration) * greedy + exploration * even

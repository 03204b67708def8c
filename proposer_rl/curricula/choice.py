"""More levels than one trains on, and a choice among them by their scores."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from proposer_rl.curricula.base import Proposal
from proposer_rl.curricula.batches import levels_at
from proposer_rl.curricula.checks import real, whole
from proposer_rl.curricula.scores import Scorer
from proposer_rl.learning import PPO
from proposer_rl.streams import Streams


class Choice:
    """Trains on some of several times as many candidates, those that there is most to learn on.

    P levels are drawn one after another, none of them twice, each in proportion to

        exp( score / temperature )

    of those that are left. With learnability p (1 - p) as the score, what is mastered and what is
    out of reach gets the smallest shares, wherever the candidates come from: the idea of SFL
    (arXiv 2408.15099) and NCC (arXiv 2505.20659), which keep their candidates in a buffer.

    Args:
        scorer: which knows the task, and scores its levels.
        times: candidates for each level that is trained on.
        temperature: of the draws, in units of the score.

    Raises:
        ValueError: if a number is out of range.
    """

    def __init__(self, scorer: Scorer, *, times: int, temperature: float) -> None:
        self._scorer = scorer
        self.times = whole("times", times, 2)
        self._temperature = real("temperature", temperature, above=0)

    def __call__(
        self, learner: PPO, candidates: Proposal, streams: Sequence[Streams]
    ) -> tuple[Tensor, Proposal]:
        """Choose.

        Args:
            learner: the Solvers.
            candidates: levels [K, times * P], and what they have cost.
            streams: of the present update.

        Returns:
            The places of the chosen ones, int64 [K, P], and their proposal, whose costs are those
            of the candidates and of scoring them.
        """
        levels = candidates.levels
        scored, frames, evaluations = self._scorer(learner, levels, streams, "choice")
        index = draw_without_replacement(
            scored.score / self._temperature,
            levels.shape[1] // self.times,
            [s.generator("choice") for s in streams],
        )
        return index, Proposal(
            levels_at(levels, index),
            candidates.frames + frames,
            candidates.evaluations + evaluations,
        )


def draw_without_replacement(
    logits: Tensor, count: int, generators: Sequence[torch.Generator]
) -> Tensor:
    """Draw places one after another, in proportion to exp(logit) of those that are left.

    The largest of the logits with Gumbel noise are such draws (Kool et al. 2019, arXiv 1903.06059).

    Args:
        logits: float [K, M]; minus infinity for places that are only drawn where no
            other is left.
        count: number P of draws.
        generators: one for each row.

    Returns:
        int64 [K, P], no place twice.
    """
    uniform = torch.stack(
        [torch.rand(logits.shape[1], generator=g, dtype=torch.float64) for g in generators]
    )
    gumbel = -(-uniform.log()).log()
    # Lower than any score, but finite: noise decides among levels without one.
    return (logits.double().nan_to_num(neginf=-1e9) + gumbel).topk(count).indices

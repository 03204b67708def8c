"""Curricula made of other curricula: filtered, one after another, or several at once."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any

import torch
from annotated_types import Interval, Len
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula.contract import Batch, Curriculum, LearnedCurriculum, proposed
from proposer_rl.curricula.scores import OwnScore, Scorer, Source
from proposer_rl.curricula.student import Student
from proposer_rl.meta.assembly import Components
from proposer_rl.settings import ArgumentError, Count, NotNegative, Positive, checked
from proposer_rl.streams import Streams


class Combinator(LearnedCurriculum):
    """Passes every call on to the curricula that it is made of; the base of those below.

    Args:
        parts: the curricula.
    """

    def __init__(self, parts: Sequence[Curriculum]) -> None:
        self.parts = list(parts)
        self.needs = tuple(dict.fromkeys(need for part in parts for need in part.needs))
        self.required_results = tuple(
            dict.fromkeys(entry for part in parts for entry in part.required_results)
        )
        self.optional_results = tuple(
            dict.fromkeys(entry for part in parts for entry in part.optional_results)
        )
        self.trains_replicas = any(part.trains_replicas for part in self._learned())

    def improve(self, student: Student, rng: Streams) -> dict[str, Any]:
        """Improves the parts that learn."""
        improved = [part.improve(student, rng) for part in self._learned()]
        return {key: value for metrics in improved for key, value in metrics.items()}

    def log(self) -> dict[str, Any]:
        """Merges the logs of the parts; where several have an entry, the last part wins."""
        return {key: value for part in self.parts for key, value in part.log().items()}

    def learnt(self) -> dict[str, Any]:
        """Returns what the last part that learns has learnt."""
        return next(filter(None, (part.learnt() for part in reversed(self.parts))), {})

    def state_dict(self) -> dict[str, Any]:
        """Returns its own state and those of the parts."""
        return {**super().state_dict(), "parts": [part.state_dict() for part in self.parts]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        super().load_state_dict(state)
        for part, own in zip(self.parts, state["parts"], strict=True):
            part.load_state_dict(own)

    def close(self) -> None:
        """Closes every part."""
        for part in self.parts:
            part.close()

    def _learned(self) -> Iterator[LearnedCurriculum]:
        return (part for part in self.parts if isinstance(part, LearnedCurriculum))


class Filtered(Combinator):
    """Draws several times as many levels as needed from a curriculum, and keeps some by score.

    The n levels that are kept are drawn without replacement, each in proportion to

        exp( score / temperature ).

    With learnability p (1 - p) as the score, levels that are mastered or out of reach get the
    smallest shares, wherever the levels come from. This is the idea of SFL (arXiv 2408.15099) and
    NCC (arXiv 2505.20659), which keep their candidates in a buffer. The curriculum observes the
    kept levels as if it had proposed only these.

    Args:
        curriculum: proposes the candidates.
        scorer: scores them.
        times: number of candidates for each level that is kept.
        temperature: of the draws, in units of the score.

    Raises:
        ValueError: if the curriculum is :class:`Mixed`.
    """

    @checked
    def __init__(
        self,
        curriculum: Curriculum,
        scorer: Scorer,
        *,
        times: Annotated[int, Interval(ge=2, le=1_000_000)] = 4,
        temperature: Positive = 0.05,
    ) -> None:
        super().__init__([curriculum])
        if _mixes(curriculum):
            raise ValueError("filter each curriculum of a mixture by itself, not the mixture")
        self.needs = tuple(dict.fromkeys((*self.needs, *scorer.needs)))
        self.required_results = tuple(dict.fromkeys((*self.required_results, *scorer.plays_for)))
        self._scorer, self._times, self._temperature = scorer, times, temperature

    @classmethod
    def around(
        cls,
        curriculum: Curriculum,
        run: Components,
        *,
        score: str | OwnScore = "learnability",
        source: Source = "exact",
        rollouts: Count = 8,
        **settings: Any,
    ) -> Filtered:
        """Makes it for a run, with a scorer of these settings; see :class:`Scorer`."""
        return cls(curriculum, Scorer(score, source, rollouts), **settings)

    def propose(self, student: Student, count: int, rng: Streams) -> Batch:
        """Draws candidates from the curriculum, and returns the levels [n] that are kept."""
        candidates = proposed(self.parts[0], student, self._times * count, rng)
        scored = self._scorer(student, candidates.levels, rng, "choice")
        draw = rng.generator("choice")
        kept = candidates[draw_without_replacement(scored.score / self._temperature, count, draw)]
        return Batch(kept.levels, kept.notes)

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Passes the outcome on to the filtered curriculum."""
        self.parts[0].observe(student, batch, outcome)


class Schedule(Combinator):
    """Follows one curriculum after another, as hand-designed ones do.

    It counts its own batches, so it does not need to know the student's updates.

    Args:
        stages: curricula, in order.
        until: number of batches after which each stage but the last ends, ascending.

    Raises:
        ArgumentError: if ``until`` is not ascending or does not fit the stages.
    """

    state = ("_proposed",)

    @checked
    def __init__(self, stages: Sequence[Curriculum], until: list[int]) -> None:
        super().__init__(stages)
        if len(until) != len(stages) - 1 or sorted({0, *until}) != [0, *until]:
            raise ArgumentError(
                f"until={until}: {len(stages)} stages need {len(stages) - 1} ascending positive "
                "numbers of updates"
            )
        self._until = list(until)
        self._proposed = 0

    def propose(self, student: Student, count: int, rng: Streams) -> Batch:
        """Returns what the current stage proposes."""
        stage = self._stage
        batch = proposed(self.parts[stage], student, count, rng)
        self._proposed += 1
        notes = {"stage": torch.full((count,), stage), "notes": batch.notes}
        return Batch(batch.levels, TensorDict(notes, [count]))

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Passes the outcome on to the stage that proposed the levels."""
        if len(batch):
            own = Batch(batch.levels, batch.notes["notes"], batch.size)
            self.parts[int(batch.notes["stage"][0])].observe(student, own, outcome)

    def improve(self, student: Student, rng: Streams) -> dict[str, Any]:
        """Improves the stage that is current when the cycle begins."""
        part = self.parts[self._stage]
        return part.improve(student, rng) if isinstance(part, LearnedCurriculum) else {}

    @property
    def _stage(self) -> int:
        return bisect_right(self._until, self._proposed)


class Mixed(Combinator):
    """Fills each batch with a fixed share of levels from every curriculum.

    Args:
        curricula: all with the same kind of levels.
        shares: of each in a batch, not negative; rounded so that whole levels add up.

    Raises:
        ArgumentError: if there is not one share for each curriculum, or all are zero.
    """

    @checked
    def __init__(
        self, curricula: Sequence[Curriculum], shares: Annotated[list[NotNegative], Len(1)]
    ) -> None:
        super().__init__(curricula)
        if len(shares) != len(curricula) or not any(shares):
            raise ArgumentError(
                f"shares={shares}: {len(curricula)} curricula need as many, not all of them zero"
            )
        self._ends = [sum(shares[: i + 1]) / sum(shares) for i in range(len(shares))]

    def propose(self, student: Student, count: int, rng: Streams) -> Batch:
        """Returns levels [n], those of the first curriculum first."""
        ends = [round(end * count) for end in self._ends]
        counts = [end - start for start, end in zip([0, *ends], ends, strict=False)]
        batches = {
            i: proposed(self.parts[i], student, some, rng.within("part", i))
            for i, some in enumerate(counts)
            if some
        }
        whose = torch.arange(len(counts)).repeat_interleave(torch.tensor(counts))
        # Every level has notes of each curriculum; only those of its own are used.
        place = torch.cat([torch.arange(some) for some in counts])
        notes = {
            str(i): batch.notes[place.clamp(max=len(batch) - 1)] for i, batch in batches.items()
        }
        levels = torch.cat([batch.levels for batch in batches.values()])
        sizes = torch.tensor(counts)[whose]
        return Batch(levels, TensorDict({"part": whose, "size": sizes, **notes}, [count]))

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Passes the outcome of each level on to the curriculum that proposed it."""
        whose, sizes = batch.notes["part"], batch.notes["size"]
        for i in whose.unique().tolist():
            own = (whose == i).nonzero().flatten()
            part = Batch(batch.levels[own], batch.notes[str(i)][own], int(sizes[own[0]]))
            self.parts[i].observe(student, part, outcome[own])

    def log(self) -> dict[str, Any]:
        """Returns the logs of the parts, with the number of the part before each entry."""
        record: dict[str, Any] = {}
        for i, part in enumerate(self.parts):
            record |= {f"{i}_{key}": value for key, value in part.log().items()}
        return record


def _mixes(curriculum: Curriculum) -> bool:
    parts = curriculum.parts if isinstance(curriculum, Combinator) else []
    return isinstance(curriculum, Mixed) or any(map(_mixes, parts))


def draw_without_replacement(logits: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Draws places without replacement, each in proportion to exp(logit) of those left.

    The largest of the logits with Gumbel noise are such draws (Kool et al. 2019, arXiv 1903.06059).

    Args:
        logits: float [M]; places with minus infinity are only drawn when no others are left.
        count: number n of draws.
        generator: of the CPU.

    Returns:
        int64 [n], no place twice.
    """
    uniform = torch.rand(len(logits), generator=generator, dtype=torch.float64)
    gumbel = -(-uniform.log()).log()
    # Lower than any score, but finite: noise decides among levels without one.
    return (logits.double().nan_to_num(neginf=-1e9) + gumbel).topk(count).indices

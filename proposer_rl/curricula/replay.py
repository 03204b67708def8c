"""Curricula that replay levels from a buffer: PLR, robust PLR, ACCEL and NCC.

The methods are options of one loop:

- PLR (Jiang et al. 2021, arXiv 2010.03934): with probability q a batch is drawn from the buffer,
  otherwise it is new. The Solver trains on either, and its episodes score the levels.
- Robust PLR (arXiv 2110.02439): the Solver trains on replayed levels, and only plays new ones.
  Batch-synchronous (minimax, arXiv 2311.12716): in every update one new batch is scored and one is
  replayed, so that several Solvers do the same at the same time.
- ACCEL (Parker-Holder et al. 2022, arXiv 2203.01302): in addition, levels that were trained on are
  edited, and their children are scored like new levels.
- With an exact score, new levels cost evaluations instead of episodes.
- NCC (arXiv 2505.20659): all scores are renewed before each draw, which follows their softmax, the
  closed form of its inner problem, max over y of <y, s> + temperature * entropy(y).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal, cast

import torch
from annotated_types import Interval, Len
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula.batches import (
    CPU,
    SomeBins,
    device_of,
    level_keys,
    moved,
    packed,
    unpacked,
)
from proposer_rl.curricula.buffer import (
    Prioritization,
    ReplayRule,
    draw_slots,
    empty_buffer,
    insert,
    replay_weights,
    rescore,
)
from proposer_rl.curricula.contract import Batch, Curriculum
from proposer_rl.curricula.scores import OwnScore, Scored, Scorer, Source, episodes, unseen
from proposer_rl.curricula.student import Student
from proposer_rl.learning import DivergedError
from proposer_rl.meta.assembly import Components
from proposer_rl.settings import ArgumentError, Count, Positive, Share, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Distribution, Levels, Space

Edit = Callable[[Levels, int, Sequence[torch.Generator]], Levels]
"""Edits levels [K, n] by a number of small random changes each; row k draws from generator k."""
Parents = Literal["batch", "easy"]

EASY = 4  # parents of a batch of children, unless all of the batch are


class ReplayCurriculum(Curriculum):
    """Replays levels from a buffer by their scores, and adds new or edited ones.

    Args:
        space: from which new levels are drawn.
        scorer: scores the levels.
        rule: how levels are drawn, and which one makes room for another.
        new_levels: restricts new levels to some bins of the space: allowed values of some of its
            axes, by name; None for the whole space.
        capacity: number N of levels in the buffer.
        fill: share of the capacity that must have been scored before levels are replayed.
        replay_probability: q; has no effect if ``synchronous``.
        train_on_new: whether the student also trains on new levels.
        synchronous: whether each proposal scores one new batch and replays another; None for the
            opposite of ``train_on_new``.
        edits: number of edits that make a child; 0 for no children.
        edit: returns levels [K, n] after this number of small random edits each.
        parents: of a batch of children: all levels that were trained on (``batch``), or the four of
            them with the lowest difference of mean return and mean absolute advantage (``easy``).
        renew: whether to renew all scores before each draw, instead of the scores of the levels
            that were trained on.

    Raises:
        DivergedError: in :meth:`propose`, if a level is to be replayed and none has a score.
        ArgumentError: if edits are asked for and the task has none, or options contradict.
    """

    state = ("_scored", "_came_back", "buffer", "_last")

    @checked
    def __init__(
        self,
        space: Distribution,
        scorer: Scorer,
        rule: ReplayRule | None = None,
        edit: Edit | None = None,
        *,
        new_levels: dict[str, Annotated[list[float], Len(1)]] | None = None,
        capacity: Count = 4000,
        fill: Positive = 0.5,
        replay_probability: Annotated[float, Interval(gt=0, le=1)] = 0.5,
        train_on_new: bool = False,
        synchronous: bool | None = None,
        edits: Annotated[int, Interval(ge=0, le=1_000_000)] = 0,
        parents: Parents = "batch",
        renew: bool = False,
    ) -> None:
        synchronous = not train_on_new if synchronous is None else synchronous
        if train_on_new and synchronous:
            raise ArgumentError(
                "train_on_new=true, synchronous=true: new levels are either trained on or only "
                "scored; set one of the two to false"
            )
        if edits and edit is None:
            raise ArgumentError(
                f"edits={edits}: the task must define edit(levels, count, generators); otherwise "
                "set edits=0"
            )
        self._edit, self._edits, self._easy = edit, edits, edits > 0 and parents == "easy"
        # Levels are scored without training if they are new and not trained on, edited or renewed.
        aside = not train_on_new or edits or renew
        self.needs = scorer.needs if aside else scorer.asks
        self.required_results = (
            (*scorer.required_results, "rollout") if self._easy else scorer.required_results
        )
        bins = space if new_levels is None else SomeBins(cast(Space, space), new_levels)
        self._new_levels = bins
        self.scorer, self._rule = scorer, rule or ReplayRule()
        self._capacity, self._warm = capacity, fill * capacity
        self._probability = replay_probability
        self._synchronous, self._train_on_new = synchronous, train_on_new
        self._renew = renew
        self._template = self._new_levels.sample(1, torch.Generator())[0]
        self._device = device_of(self._template)
        self.buffer = empty_buffer(self._template, self._capacity)
        # Batches [m] whose children, or exact scores, are due at the next proposal.
        self._due: list[TensorDict] = []
        self._last: Levels = self.buffer["level"][:0]  # what was observed last, [m]
        self._scored = 0  # new levels
        self._came_back = {"levels": 0, "replayed": 0}

    @classmethod
    def create(
        cls,
        run: Components,
        *,
        score: str | OwnScore = "positive_value_loss",
        source: Source = "episodes",
        rollouts: Count = 1,
        prioritization: Prioritization = ReplayRule.prioritization,
        temperature: Positive = ReplayRule.temperature,
        best: Count | None = ReplayRule.best,
        staleness: Share = ReplayRule.staleness,
        **settings: Any,
    ) -> ReplayCurriculum:
        """Makes it for a run's space and edits; see :class:`Scorer` and :class:`ReplayRule`."""
        rule = ReplayRule(
            prioritization=prioritization, temperature=temperature, best=best, staleness=staleness
        )
        scorer = Scorer(score, source, rollouts)
        return cls(run.task.space, scorer, rule, run.optional("edit"), **settings)

    def propose(self, student: Student, count: int, rng: Streams) -> Batch:
        """Returns levels [n], all of them replayed or all of them new."""
        self._finish(student, rng)
        slots = torch.zeros(count, dtype=torch.int64)
        if replayed := self._explore(student, count, rng):
            if self._renew:
                self._score_all(student, rng)
            slots = draw_slots(self.buffer, count, self._rule, rng.generator("slots"))
            levels = self.buffer["level"][slots]
        else:
            levels = self._fresh(count, rng, "new")
        known = {name: self.buffer[name][slots] for name in ("best", "key", "reached")}
        if not replayed:
            known |= {
                name: torch.full_like(known[name], -torch.inf) for name in ("best", "reached")
            }
        notes = {
            "slot": slots,
            "replayed": torch.full((count,), replayed),
            "key": known["key"],
            "best": known["best"],
            "before": self._expected(known["reached"]),
        }
        return Batch(moved(levels, self._device), TensorDict(notes, [count]))

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Scores the levels, if scores come from episodes."""
        notes = dict(batch.notes.items())
        evidence = {"level": moved(batch.levels, CPU)}
        evidence |= {name: notes[name] for name in ("slot", "replayed", "key")}
        if self._easy:
            evidence["easy"] = easiness(student, outcome)
        self._came_back["levels"] += len(batch)
        self._came_back["replayed"] += int(notes["replayed"].sum())
        self._last = evidence["level"]
        if self.scorer.from_episodes:
            scored = self.scorer.of_outcome(student, outcome, notes["best"], notes["before"])
            self._take(evidence, scored, outcome["return"].float().cpu())
        if self._edits or not self.scorer.from_episodes:
            self._due.append(TensorDict(evidence, [len(batch)]))

    def log(self) -> dict[str, Any]:
        """Returns the share of replayed levels, and statistics of the buffer."""
        buffer, filled = self.buffer, self.buffer["filled"]
        if not bool(filled.any()):
            return {}
        age = buffer["clock"] - buffer["touched"]
        shares = replay_weights(buffer["score"], age, filled, self._rule)
        count = filled.sum()
        record = {
            "replayed": self._came_back["replayed"] / max(self._came_back["levels"], 1),
            "filled": int(count),
            "effective_levels": float(1 / shares.square().sum()),
            "mean_score": float(buffer["score"].where(filled, 0).sum() / count),
            "mean_generation": float(buffer["generation"].where(filled, 0).sum() / count),
        }
        if len(self._last):
            record["distinct_levels"] = len(level_keys(self._last).unique())
        self._came_back = {"levels": 0, "replayed": 0}
        return record

    def state_dict(self) -> dict[str, Any]:
        """Adds the levels whose exact scores or children are due."""
        return super().state_dict() | {"due": [packed(evidence) for evidence in self._due]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        super().load_state_dict(state)
        like = self.buffer.select("level")
        self._due = [unpacked(evidence, like) for evidence in state["due"]]

    def _finish(self, student: Student, rng: Streams) -> None:
        """Computes the exact scores, and the children, of levels that were trained on."""
        due, self._due = self._due, []
        for i, evidence in enumerate(due):
            which = (i,) if i else ()
            replayed = bool(evidence["replayed"][0])
            # If all scores are renewed anyway, levels of the buffer need no score here.
            if not self.scorer.from_episodes and not (self._renew and replayed):
                scored = self._score(student, evidence["level"], rng, "trained", *which)
                self._take(evidence, scored, unseen(len(evidence)))
            if self._edits and replayed:
                children, origin = self._children(evidence, rng.generator("edits", *which))
                scored = self._score(student, children, rng, "children", *which)
                self._add(children, scored, **origin)

    def _children(
        self, evidence: TensorDictBase, draw: torch.Generator
    ) -> tuple[Levels, dict[str, Tensor]]:
        """Edits levels that were trained on; returns the children [m] and their origin."""
        assert self._edit is not None  # or there are no edits
        some = parents_among(evidence)
        parents, slots = evidence["level"][some], evidence["slot"][some]
        origin = {"parent": level_keys(parents), "generation": self.buffer["generation"][slots] + 1}
        return self._edit(parents.unsqueeze(0), self._edits, [draw])[0], origin

    def _explore(self, student: Student, count: int, rng: Streams) -> bool:
        """Scores as many new levels as are needed; returns whether to replay the next batch."""
        batches = 0
        while True:
            chance = torch.rand((), generator=rng.generator("replay", batches))
            replayed = bool(chance < self._probability)
            if self._synchronous:
                replayed = batches > 0
            replayed = replayed and self._scored >= self._warm
            if replayed and not bool(self.buffer["filled"].any()):
                raise DivergedError(
                    f"on none of {self._scored} new levels did an episode end within a rollout, so "
                    "none has a score; try longer rollouts (the horizon)"
                )
            if self._train_on_new or replayed:
                return replayed
            levels = self._fresh(count, rng, "explore", batches)
            self._add(levels, self._score(student, levels, rng, batches))
            batches += 1

    def _add(self, levels: Levels, scored: Scored, **more: Tensor) -> None:
        """Inserts new levels [m] into the buffer."""
        new = {"level": levels, **scored._asdict(), **more}
        insert(self.buffer, TensorDict(new, [len(levels)]), self._rule)
        self._scored += len(levels)

    def _score(
        self,
        student: Student,
        levels: Levels,
        rng: Streams,
        *purpose: str | int,
        reached: Tensor | None = None,
    ) -> Scored:
        """Scores levels [m] that are not trained on; for ``reached`` see :meth:`_expected`."""
        before = self._expected(unseen(len(levels)) if reached is None else reached)
        return self.scorer(student, moved(levels, self._device), rng, *purpose, before=before)

    def _expected(self, reached: Tensor) -> Tensor:
        """Fills unknown entries of ``reached`` [m] with the mean over the buffer."""
        known = self.buffer["reached"]
        mean = known.where(known.isfinite(), torch.nan).nanmean()
        return reached.where(reached.isfinite(), mean.nan_to_num(-torch.inf))

    def _score_all(self, student: Student, rng: Streams) -> None:
        """Scores all levels of the buffer anew."""
        filled, place = self.buffer["filled"], torch.arange(self._capacity)
        # Empty slots hold no level that could be played: the first level stands in for them.
        slots = place.where(filled, 0)
        levels, reached = self.buffer["level"][slots], self.buffer["reached"][slots]
        rescore(self.buffer, slots, *self._score(student, levels, rng, "all", reached=reached))

    def _take(self, evidence: Mapping[str, Any], scored: Scored, reached: Tensor) -> None:
        """Stores the scores of levels that were trained on; new levels enter the buffer.

        Args:
            evidence: what is known about the levels [m].
            scored: their scores.
            reached: their returns, float [m]; minus infinity where unknown.
        """
        if not bool(evidence["replayed"][0]):
            self._add(evidence["level"], scored, reached=reached)
            return
        slots = evidence["slot"]
        # By the time a result comes back, another level may have taken the slot.
        there = self.buffer["key"][slots] == evidence["key"]
        new = (entry.where(there, -torch.inf) for entry in (*scored, reached))
        rescore(self.buffer, slots, *new)

    def _fresh(self, count: int, rng: Streams, *purpose: str | int) -> Levels:
        """Draws new levels [count] on the CPU."""
        return moved(self._new_levels.sample(count, rng.generator(*purpose)), CPU)


def parents_among(evidence: TensorDictBase) -> Tensor:
    """Returns the places of the parents of n children among n levels: int64 [n].

    Every level that was trained on is a parent; but if evidence [n] has the entry ``easy``, only
    the few levels with the highest values are.
    """
    count = len(evidence)
    if "easy" not in evidence.keys():
        return torch.arange(count)
    easiest = evidence["easy"].topk(min(EASY, count)).indices
    return easiest.repeat_interleave(-(-count // EASY))[:count]


def easiness(student: Student, outcome: TensorDictBase) -> Tensor:
    """Returns mean absolute advantage minus mean return [n]; "easy" parents have the highest.

    The authors' code (dcd) takes the levels with the lowest return minus value loss.
    """
    rollout = outcome["rollout"]
    ended = episodes(rollout)
    loss = Scorer("l1_value_loss", "episodes")
    lost = loss.of_rollouts(student, [rollout], unseen(len(rollout))).score
    return lost - (ended.total / ended.ended.clamp(1)).cpu()

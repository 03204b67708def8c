"""Curricula that keep levels and train on them again: PLR, robust PLR, ACCEL and their relatives.

One loop with options, which is what the methods differ in:

- PLR (Jiang et al. 2021, arXiv 2010.03934): with probability q the batch is drawn from the buffer,
  else it is new; the Solver trains on either, and what it does there scores the levels.
- robust PLR (arXiv 2110.02439): it trains on replayed levels alone; new ones are only played on.
  Batch-synchronous (minimax, arXiv 2311.12716): at every update one new batch is scored and one is
  replayed, so that several Solvers do the same thing at the same time.
- ACCEL (Parker-Holder et al. 2022, arXiv 2203.01302): besides, what was trained on is edited, and
  the children are scored like new levels.
- With an exact score new levels cost no episodes, but evaluations.
- NCC (arXiv 2505.20659): all scores are renewed before each draw, from a softmax over them. Its
  inner problem, max over y of <y, s> + temperature * entropy(y), has that closed form.
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
    fresh_levels,
    level_keys,
    levels_at,
    moved,
    of_kind,
    packed,
    unpacked,
)
from proposer_rl.curricula.buffer import (
    Prioritization,
    ReplayRule,
    draw_slots,
    empty_buffer,
    insert,
    lineage,
    replay_weights,
    rescore,
)
from proposer_rl.curricula.contract import Batch, Curriculum, Inbox
from proposer_rl.curricula.scores import OwnScore, Scored, Scorer, Source, episodes, unseen
from proposer_rl.curricula.student import Student
from proposer_rl.learning import DivergedError
from proposer_rl.meta.assembly import Components
from proposer_rl.settings import ArgumentError, Count, Positive, Share, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Distribution, Levels, Space

Edit = Callable[[Levels, int, Sequence[torch.Generator]], Levels]
"""Levels [K, n] after so many small random edits each, student k's from generator k."""
Parents = Literal["batch", "easy"]

EASY = 4  # parents of a batch of edits, where they are not all of the batch
SHOWN = 6  # levels of each kind that a reader is shown


class ReplayCurriculum(Curriculum):
    """Draws each student's batch from a buffer of levels by their scores.

    Args:
        space: where levels come from that are not edited.
        scorer: of levels.
        rule: how levels are drawn, and which one makes room for another.
        new_levels: of the space, the bins that they come from: for some of its axes, by name, the
            values that count; None for the whole space.
        capacity: levels N of the buffer.
        fill: share of the capacity that must have been scored before any is replayed.
        replay_probability: q; has no effect where ``synchronous``.
        train_on_new: whether students also train on new levels.
        synchronous: whether each proposal has one new batch that is scored, and one that is
            replayed; None for yes, unless new levels are trained on.
        edits: of each child; 0 for no children.
        edit: makes children: levels [K, n] after so many small random edits each.
        parents: of a batch of children: all that was trained on (``batch``), or the four of it with
            the lowest difference of mean return and mean absolute advantage (``easy``).
        renew: whether all scores are renewed before each draw, instead of those of what was trained
            on.
        co_learnability: what is added to the scores of the levels trained on before, for each unit
            by which the scores of those trained on now have fallen (TRACED, arXiv 2506.19997).
        seeds: of the students; as many as there are of them can be refused at once.

    Raises:
        DivergedError: in :meth:`propose`, if there is no level with a score where one is to be
            replayed.
        ArgumentError: if there are to be edits and nothing makes them, or options contradict.
    """

    state = ("_scored", "_came_back", "_before", "_inbox")

    @checked
    def __init__(
        self,
        space: Distribution,
        scorer: Scorer,
        rule: ReplayRule | None = None,
        edit: Edit | None = None,
        seeds: Sequence[int] = (0,),
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
        co_learnability: float = 0.0,
    ) -> None:
        synchronous = not train_on_new if synchronous is None else synchronous
        if train_on_new and synchronous:
            raise ArgumentError(
                "train_on_new=true, synchronous=true: new levels are either trained on or only "
                "scored; set one of them to false"
            )
        if renew and co_learnability:
            raise ArgumentError(
                f"co_learnability={co_learnability}, renew=true: where all scores are renewed "
                "before each draw, nothing is left of what is added to them; set one of them to 0"
            )
        if edits and edit is None:
            raise ArgumentError(
                f"edits={edits}: the task has no edit(levels, count, generators) of its levels; "
                "set edits=0"
            )
        self._edit, self._edits, self._easy = edit, edits, edits > 0 and parents == "easy"
        # Levels are scored aside where they are new and not trained on, edited, or renewed.
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
        self._renew, self._co_learnability = renew, co_learnability
        self._template = self._new_levels.sample(1, torch.Generator())[0]
        self._device = device_of(self._template)
        self.buffer = empty_buffer(self._template, 0, self._capacity)
        self._inbox = Inbox(self._template)
        # Evidence [K, m] whose children, or exact scores, are due at the next proposal.
        self._due: list[TensorDict] = []
        self._last: Levels = self.buffer["level"]  # [K, m] of the evidence before
        # "slot" and "key" [K, m] of the levels that were trained on the time before.
        self._before: dict[str, Tensor] = {}
        self._scored = 0  # new levels of each student
        self._came_back = {"levels": 0, "replayed": 0}
        self.check(len(seeds))

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
        """Makes it for a run's space and edits: see :class:`Scorer` and :class:`ReplayRule`."""
        rule = ReplayRule(
            prioritization=prioritization, temperature=temperature, best=best, staleness=staleness
        )
        scorer = Scorer(score, source, rollouts)
        return cls(run.task.space, scorer, rule, run.optional("edit"), run.seeds, **settings)

    def check(self, students: int) -> None:
        """Refuses several students, if each would decide by itself how many new levels to score.

        Raises:
            ValueError: if so.
        """
        if students > 1 and not (self._train_on_new or self._synchronous):
            raise ValueError(
                f"{students} Solvers: each would decide by itself how many new levels to score; "
                "set synchronous=true, or give one run for each"
            )

    def propose(self, student: Student, count: int, streams: Sequence[Streams]) -> Batch:
        """Returns levels [K, n], replayed or new.

        Raises:
            ValueError: as :meth:`check`.
        """
        students = len(streams)
        self.check(students)
        if not len(self.buffer):
            self.buffer = empty_buffer(self._template, students, self._capacity)
        self._take_in()
        self._finish(student, streams)
        replayed = self._explore(student, count, streams)
        each, slots = replayed.unsqueeze(-1), torch.zeros(students, count, dtype=torch.int64)
        new = None if bool(replayed.all()) else self._fresh(count, streams, "new")
        levels = new
        if bool(replayed.any()):
            if self._renew:
                self._score_all(student, streams)
            draws = [s.generator("slots") for s in streams]
            slots = draw_slots(self.buffer, count, self._rule, draws, replayed)
            levels = levels_at(self.buffer["level"], slots)
            if new is not None:
                levels[~replayed] = new[~replayed]
        buffer = dict(self.buffer.items())
        known = {name: buffer[name].gather(1, slots) for name in ("best", "key", "reached")}
        return self._inbox.batch(
            moved(levels, self._device),
            slot=slots,
            replayed=each.expand(students, count),
            key=known["key"],
            best=known["best"].where(each, -torch.inf),
            before=self._expected(known["reached"].where(each, -torch.inf)),
        )

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Scores the levels by the episodes on them, where these are what scores are made of."""
        self._inbox.check(batch, outcome)
        notes = dict(batch.notes.items())
        evidence = {"level": moved(batch.levels, CPU)}
        evidence |= {name: notes[name] for name in ("slot", "replayed", "key")}
        if self.scorer.from_episodes:
            known = notes["best"], notes["before"]
            evidence |= self.scorer.of_outcome(student, outcome, *known)._asdict()
            evidence["reached"] = outcome["return"].float()
        if self._easy:
            evidence["easy"] = easiness(student, outcome)
        self._came_back["levels"] += notes["replayed"].numel()
        self._came_back["replayed"] += int(notes["replayed"].sum())
        self._inbox.put(batch, **evidence)

    def log(self) -> dict[str, Any]:
        """Returns how much was replayed, and statistics of the buffers."""
        self._take_in()
        buffer, filled = self.buffer, self.buffer["filled"]
        if not len(buffer) or not bool(filled.any()):
            return {}
        age = buffer["clock"] - buffer["touched"]
        shares = replay_weights(buffer["score"], age, filled, self._rule)
        count = filled.sum(-1)
        record = {
            "replayed": self._came_back["replayed"] / max(self._came_back["levels"], 1),
            "filled": count.tolist(),
            "effective_levels": (1 / shares.square().sum(-1)).tolist(),
            "mean_score": (buffer["score"].where(filled, 0).sum(-1) / count).tolist(),
            "mean_generation": (buffer["generation"].where(filled, 0).sum(-1) / count).tolist(),
            "levels": self._shown(),
        }
        if len(self._last):
            record["distinct_levels"] = [len(own.unique()) for own in level_keys(self._last)]
        self._came_back = {"levels": 0, "replayed": 0}
        return record

    def state_dict(self) -> dict[str, Any]:
        """Returns also the buffers, and what is known of the levels that were trained on."""
        return super().state_dict() | {
            "buffer": packed(self.buffer),
            "last": packed(self._last),
            "due": [packed(evidence) for evidence in self._due],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Puts back what :meth:`state_dict` returned."""
        super().load_state_dict(state)
        self.buffer = unpacked(state["buffer"], self._template)
        self._last = of_kind(self._template, state["last"])
        self._due = [unpacked(evidence, self._template) for evidence in state["due"]]

    def _take_in(self) -> None:
        """Takes what episodes have shown into the buffers, and notes what remains to be done."""
        for evidence in self._inbox.take(whole=self._easy):
            self._last = evidence["level"]
            if self.scorer.from_episodes:
                self._take(evidence, Scored(evidence["score"], evidence["best"]))
            if self._edits or not self.scorer.from_episodes:
                self._due.append(evidence)

    def _finish(self, student: Student, streams: Sequence[Streams]) -> None:
        """Scores exactly the levels that were trained on, and makes and scores their children."""
        due, self._due = self._due, []
        for i, evidence in enumerate(due):
            which = (i,) if i else ()
            replayed = evidence["replayed"][:, 0]
            # Where all scores are renewed, those of levels of the buffer need not be taken.
            known = self._renew and bool(replayed.all())
            if not self.scorer.from_episodes and not known:
                scored = self._score(student, evidence["level"], streams, "trained", *which)
                self._take(evidence, scored)
            if self._edits and bool(replayed.any()):
                children, origin = self._children(
                    evidence, [s.generator("edits", *which) for s in streams]
                )
                scored = self._score(student, children, streams, "children", *which)
                self._add(children, scored, replayed, **origin)

    def _children(
        self, evidence: TensorDictBase, draws: Sequence[torch.Generator]
    ) -> tuple[Levels, dict[str, Tensor]]:
        """Returns children [K, n] of levels that were trained on, and where they come from."""
        assert self._edit is not None  # or there are no edits
        some = parents_among(evidence)
        parents, slots = levels_at(evidence["level"], some), evidence["slot"].gather(1, some)
        generation = self.buffer["generation"].gather(1, slots) + 1
        origin = {"parent": level_keys(parents), "generation": generation}
        return self._edit(parents, self._edits, draws), origin

    def _explore(self, student: Student, count: int, streams: Sequence[Streams]) -> Tensor:
        """Scores new levels as long as it takes; returns whose next batch is replayed, bool [K]."""
        batches = 0
        while True:
            draws = [s.generator("replay", batches) for s in streams]
            chance = torch.stack([torch.rand((), generator=g) for g in draws])
            replayed = chance < self._probability
            if self._synchronous:
                replayed = torch.full_like(replayed, batches > 0)
            replayed &= self._scored >= self._warm
            if bool((replayed & ~self.buffer["filled"].any(-1)).any()):
                raise DivergedError(
                    f"on none of {self._scored} new levels did an episode end within a rollout, so "
                    "that none has a score; longer rollouts (the horizon) may"
                )
            if self._train_on_new or bool(replayed.all()):
                return replayed
            levels = self._fresh(count, streams, "explore", batches)
            self._add(levels, self._score(student, levels, streams, batches))
            batches += 1

    def _add(
        self,
        levels: Levels,
        scored: Scored,
        wanted: Tensor | None = None,
        **more: Tensor,
    ) -> None:
        """Inserts new levels [K, n] into the buffers, for the ``wanted`` students."""
        new = TensorDict({"level": levels, **scored._asdict(), **more}, levels.shape[:2])
        insert(self.buffer, new, self._rule, wanted)
        self._scored += new.shape[1]

    def _score(
        self,
        student: Student,
        levels: Levels,
        streams: Sequence[Streams],
        *purpose: str | int,
        reached: Tensor | None = None,
    ) -> Scored:
        """Scores levels [K, n] that nobody trains on; ``reached`` as in :meth:`_expected`."""
        before = self._expected(unseen(levels.shape[:2]) if reached is None else reached)
        return self.scorer(student, moved(levels, self._device), streams, *purpose, before=before)

    def _expected(self, reached: Tensor) -> Tensor:
        """Returns what was ``reached`` [K, n], or if unknown the mean over the buffer."""
        known = self.buffer["reached"]
        mean = known.where(known.isfinite(), torch.nan).nanmean(-1, keepdim=True)
        return reached.where(reached.isfinite(), mean.nan_to_num(-torch.inf))

    def _score_all(self, student: Student, streams: Sequence[Streams]) -> None:
        """Renews all scores."""
        filled, place = self.buffer["filled"], torch.arange(self._capacity)
        # An empty slot holds no level that could be played: the first one stands in for it.
        slots = place.where(filled, 0)
        levels, reached = levels_at(self.buffer["level"], slots), self.buffer["reached"]
        scored = self._score(student, levels, streams, "all", reached=reached.gather(1, slots))
        rescore(self.buffer, slots, *scored)

    def _take(self, evidence: TensorDictBase, scored: Scored) -> None:
        """Takes the scores of levels that were trained on; new levels go into the buffer."""
        replayed, slots = evidence["replayed"][:, 0], evidence["slot"]
        reached = evidence.get("reached", unseen(slots.shape))
        if bool(replayed.any()):
            # Another level may have taken the place of one that was long on its way.
            there = self.buffer["key"].gather(1, slots) == evidence["key"]
            there &= evidence["replayed"]
            before = self.buffer["score"].gather(1, slots)
            rescore(
                self.buffer,
                slots,
                scored.score.where(there, -torch.inf),
                scored.best.where(there, -torch.inf),
                reached.where(there, -torch.inf),
            )
            if self._co_learnability:
                self._credit(before, slots, replayed)
        if not bool(replayed.all()):
            self._add(evidence["level"], scored, ~replayed, reached=reached)

    def _credit(self, score: Tensor, slots: Tensor, replayed: Tensor) -> None:
        """Credits the levels trained on before with how far the scores [K, m] in these slots fell.

        Only students whose levels were ``replayed``, bool [K], get it.
        """
        fell = (score - self.buffer["score"].gather(1, slots)).mean(1, keepdim=True)
        now = {"slot": slots, "key": self.buffer["key"].gather(1, slots)}
        before = self._before or {"slot": slots, "key": torch.full_like(slots, -1)}
        each = replayed.unsqueeze(-1)
        there = self.buffer["key"].gather(1, before["slot"]) == before["key"]  # not evicted since
        credited = torch.zeros_like(self.buffer["filled"]).scatter(1, before["slot"], there & each)
        self.buffer["score"] += self._co_learnability * fell * credited
        # Batches differ in size: the last level over again is credited no more than once.
        width = torch.arange(max(before["slot"].shape[1], slots.shape[1]))
        self._before = {
            name: torch.where(
                each,
                now[name][:, width.clamp(max=slots.shape[1] - 1)],
                before[name][:, width.clamp(max=before[name].shape[1] - 1)],
            )
            for name in now
        }

    def _fresh(self, count: int, streams: Sequence[Streams], *purpose: str | int) -> Levels:
        """Draws new levels [K, count] on the CPU."""
        return moved(fresh_levels(self._new_levels, count, streams, *purpose), CPU)

    def _shown(self) -> dict[str, Levels]:
        """Returns levels of the first student's buffer for reports, by their captions."""
        buffer = self.buffer[0][self.buffer["filled"][0]]
        shown = {
            "highest scores": buffer["score"].topk(min(SHOWN, len(buffer))).indices,
            "most replayed": buffer["draws"].topk(min(SHOWN, len(buffer))).indices,
        }
        if self._edits:
            shown["the longest line of edits in the buffer"] = lineage(buffer, SHOWN)
        return {caption: buffer["level"][which] for caption, which in shown.items()}


def parents_among(evidence: TensorDictBase) -> Tensor:
    """Returns the places of the parents of n children among n levels: int64 [K, n].

    Every level that was trained on is one; or, where evidence [K, n] has the entry ``easy``, the
    few levels with most of it.
    """
    count = evidence.shape[1]
    if "easy" not in evidence.keys():
        return torch.arange(count).expand(evidence.shape)
    easiest = evidence["easy"].topk(min(EASY, count), -1).indices
    return easiest.repeat_interleave(-(-count // EASY), -1)[:, :count]


def easiness(student: Student, outcome: TensorDictBase) -> Tensor:
    """Returns mean absolute advantage minus mean return, highest for "easy" parents: [K, n].

    The authors' code (dcd) takes the levels with the lowest return minus value loss.
    """
    rollout = outcome["rollout"]
    ended = episodes(rollout)
    loss = Scorer("l1_value_loss", "episodes")
    lost = loss.of_rollouts(student, [rollout], unseen(ended.ended.shape)).score
    return lost - (ended.total / ended.ended.clamp(1)).cpu()

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

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula.base import Curriculum, Improvement, Proposal
from proposer_rl.curricula.batches import fresh_levels, levels_at
from proposer_rl.curricula.buffer import (
    SEEN,
    ReplayRule,
    draw_slots,
    empty_buffer,
    insert,
    level_keys,
    replay_weights,
    rescore,
)
from proposer_rl.curricula.checks import flag, one_of, part, real, whole
from proposer_rl.curricula.scores import Scored, Scorer, episodes, unseen
from proposer_rl.learning import PPO, DivergedError, Update
from proposer_rl.streams import Streams
from proposer_rl.task import Distribution, EditableTask, Levels

EASY = 4  # parents of a batch of edits, where they are not all of the batch
SHOWN = 6  # levels of each kind that a reader is shown


class ReplayCurriculum(Curriculum):
    """Draws each Solver's batch from a buffer of levels by their scores.

    Args:
        scorer: which knows the task, and scores its levels.
        rule: how levels are drawn, and which one makes room for another.
        new_levels: where levels come from that are not edited.
        capacity: levels N of the buffer.
        fill: share of the capacity that must have been scored before any is replayed.
        replay_probability: q; of no use where ``synchronous``.
        train_on_new: whether Solvers also train on new levels.
        synchronous: whether each update has one new batch that is scored, and one that is replayed.
        edits: of each child; 0 for no children.
        parents: of a batch of children: what was trained on (``batch``), or the four of it with the
            lowest difference of mean return and mean absolute advantage (``easy``).
        renew: whether all scores are renewed before each draw, instead of those of what was trained
            on.
        co_learnability: what is added to the scores of the levels trained on before, for each unit
            by which the scores of those trained on now have fallen (TRACED, arXiv 2506.19997).

    Raises:
        DivergedError: in :meth:`propose`, if there is no level with a score where one is to be
            replayed.
        TypeError: if there are to be edits and the task has none.
        ValueError: if a number is out of range, or the numbers do not go together.
    """

    def __init__(
        self,
        scorer: Scorer,
        rule: ReplayRule,
        new_levels: Distribution,
        *,
        capacity: int = 4000,
        fill: float = 0.5,
        replay_probability: float = 0.5,
        train_on_new: bool = False,
        synchronous: bool = True,
        edits: int = 0,
        parents: Literal["batch", "easy"] = "batch",
        renew: bool = False,
        co_learnability: float = 0.0,
    ) -> None:
        for name, value in (
            ("synchronous", synchronous), ("train_on_new", train_on_new), ("renew", renew)
        ):  # fmt: skip
            flag(name, value)
        if train_on_new and synchronous:
            raise ValueError(
                "train_on_new=true, synchronous=true: new levels are either trained on or only "
                "scored, beside every update"
            )
        one_of("parents", parents, ("batch", "easy"))
        self.scorer, self.task = scorer, scorer.task
        self._capacity = whole("capacity", capacity, 1)
        if whole("edits", edits, 0) and not isinstance(self.task, EditableTask):
            raise TypeError(
                f"edits={edits}: {type(self.task).__name__} has no edit(levels, count, generators) "
                "of its levels; set edits=0, as robust_plr does"
            )
        if parents == "easy" and self.task.batch_size % EASY:
            raise ValueError(
                f"parents=easy: {EASY} parents have as many children each, so the levels of an "
                f"update must be a multiple of {EASY}; there are {self.task.batch_size}"
            )
        if renew and co_learnability:
            raise ValueError(
                f"co_learnability={co_learnability}, renew=true: where all scores are renewed "
                "before each draw, what is added to them is lost"
            )
        if renew and scorer.from_episodes and capacity % self.task.batch_size:
            raise ValueError(
                f"capacity={capacity} must be a multiple of the {self.task.batch_size} levels of "
                "an update, where all of them are played on"
            )
        self._rule, self._new_levels = rule, new_levels
        self._warm = real("fill", fill, above=0) * capacity
        self._probability = part("replay_probability", replay_probability, above_zero=True)
        self._synchronous, self._train_on_new = synchronous, train_on_new
        self._edits, self._parents, self._renew = edits, parents, renew
        self._co_learnability = real("co_learnability", co_learnability)
        self._template = new_levels.sample(1, torch.Generator()).cpu()[0]
        self.begin()

    def begin(self) -> None:
        """Forget the last Solver's levels."""
        self.buffer = empty_buffer(self._template, 0, self._capacity)
        self._last: TensorDict | None = None  # [K, P]: "level", "replayed", of which the "slot"
        self._before: TensorDict | None = None  # [K, P]: "slot" and "key", the time before
        self._scored = 0  # new levels of each Solver
        self._told = {"updates": 0, "replayed": 0}

    def check(self, copies: int) -> None:
        """Refuse several Solvers, if each would decide by itself how much to play on new levels.

        Raises:
            ValueError: if so.
        """
        if copies > 1 and not (self._train_on_new or self._synchronous):
            raise ValueError(
                f"{copies} Solvers: each would decide by itself how many new levels to score; set "
                "synchronous=true, or give one run for each"
            )

    def propose(self, learner: PPO, updates: int, streams: Sequence[Streams]) -> Proposal:
        """Levels [K, P], replayed or new.

        Raises:
            ValueError: as :meth:`check`.
        """
        copies, count = len(streams), self.task.batch_size
        self.check(copies)
        if not len(self.buffer):
            self.buffer = empty_buffer(self._template, copies, self._capacity)
        self._cost = [0, 0]
        if self._last is not None:
            self._finish(learner, streams)
        replayed = self._explore(learner, streams)
        slots = torch.zeros(copies, count, dtype=torch.int64)
        if bool(replayed.any()):
            if self._renew:
                self._score_all(learner, streams)
            draws = [s.generator("slots") for s in streams]
            slots, drawn = draw_slots(self.buffer, count, self._rule, draws)
            self.buffer[replayed] = drawn[replayed]
        levels = levels_at(self.buffer["level"], slots)
        if not bool(replayed.all()):
            levels[~replayed] = self._fresh(streams, "new")[~replayed]
        self._last = TensorDict(
            {"level": levels, "slot": slots, "replayed": replayed[:, None].expand(copies, count)},
            (copies, count),
        )
        self._told["updates"] += copies
        self._told["replayed"] += int(replayed.sum())
        return Proposal(levels.to(self.task.device), *self._cost)

    def observe(self, learner: PPO, levels: Any, update: Update) -> None:
        """Score what was trained on, where its own episodes do."""
        last = self._last
        assert last is not None  # propose comes before
        if self.scorer.from_episodes:
            best, solved = (self.buffer[name].gather(1, last["slot"]) for name in SEEN)
            best = best.where(last["replayed"], -torch.inf)
            solved &= last["replayed"]
            self._take(last, self.scorer.of_rollouts(learner, [update.rollout], best, solved))
        if self._edits and self._parents == "easy":
            last["easy"] = _easiness(self.scorer, learner, update)

    def _explore(self, learner: PPO, streams: Sequence[Streams]) -> Tensor:
        """Score new levels as long as it takes; whether the next batch is replayed, bool [K]."""
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
                    f"solver.ppo.horizon={learner.settings.horizon}: on none of {self._scored} new "
                    "levels did an episode end within it, so that none has a score"
                )
            if self._train_on_new or bool(replayed.all()):
                return replayed
            self._add(learner, self._fresh(streams, "explore", batches), streams, batches)
            batches += 1

    def _add(
        self,
        learner: PPO,
        levels: Levels,
        streams: Sequence[Streams],
        purpose: str | int,
        parents: Mapping[str, Tensor] | None = None,
        wanted: Tensor | None = None,
    ) -> None:
        """Score levels [K, P] that nobody trains on, and keep the better ones."""
        scored = self._score(learner, levels, streams, purpose)
        new = {"level": levels, **scored._asdict(), **(parents or {})}
        self.buffer = insert(self.buffer, TensorDict(new, scored.score.shape), self._rule, wanted)
        self._scored += scored.score.shape[1]

    def _score(
        self, learner: PPO, levels: Levels, streams: Sequence[Streams], purpose: str | int
    ) -> Scored:
        """Score levels [K, n] that nobody trains on, and note what it cost."""
        scored, *cost = self.scorer(learner, levels.to(self.task.device), streams, purpose)
        self._cost = [so_far + more for so_far, more in zip(self._cost, cost, strict=True)]
        return scored

    def _score_all(self, learner: PPO, streams: Sequence[Streams]) -> None:
        """Renew all scores."""
        filled, place = self.buffer["filled"], torch.arange(self._capacity)
        # An empty slot holds no level that could be played: the first one stands in for it.
        slots = place.where(filled, 0)
        scored = self._score(learner, levels_at(self.buffer["level"], slots), streams, "all")
        self.buffer = rescore(self.buffer, slots, *scored)

    def _finish(self, learner: PPO, streams: Sequence[Streams]) -> None:
        """Do what is left to be done of the last update: exact scores, and children."""
        last, self._last = self._last, None
        assert last is not None
        # Where all scores are renewed, those of levels of the buffer need not be taken.
        known = self._renew and bool(last["replayed"].all())
        if not self.scorer.from_episodes and not known:
            self._take(last, self._score(learner, last["level"], streams, "trained"))
        replayed = last["replayed"][:, 0]
        if self._edits and bool(replayed.any()):
            count = last.shape[1]
            some = torch.arange(count).expand(last.shape)
            if self._parents == "easy":
                some = last["easy"].topk(EASY, -1).indices.repeat_interleave(count // EASY, -1)
            slot = last["slot"].gather(1, some)
            generators = [s.generator("edits") for s in streams]
            parents, edit = levels_at(last["level"], some), self.task.edit  # type: ignore[attr-defined]
            told = {
                "parent": level_keys(parents),
                "generation": self.buffer["generation"].gather(1, slot) + 1,
            }
            children = edit(parents, self._edits, generators)
            self._add(learner, children, streams, "children", told, replayed)

    def _take(self, last: TensorDictBase, scored: Scored) -> None:
        """Take the scores of levels that were trained on: new ones go into the buffer."""
        replayed = last["replayed"][:, 0]
        slots, old = last["slot"], self.buffer
        if bool(replayed.any()):
            after = rescore(old, slots, *scored)
            if self._co_learnability:
                after = self._credit(old, after, slots, replayed)
            self.buffer = old.clone()
            self.buffer[replayed] = after[replayed]
        if not bool(replayed.all()):
            new = TensorDict({"level": last["level"], **scored._asdict()}, slots.shape)
            self.buffer = insert(self.buffer, new, self._rule, ~replayed)
            self._scored += slots.shape[1]

    def _credit(
        self, old: TensorDictBase, after: TensorDict, slots: Tensor, replayed: Tensor
    ) -> TensorDict:
        """Credit the levels that were trained on before with how far the present scores fell."""
        fell = (old["score"] - after["score"]).gather(1, slots).mean(1, keepdim=True)
        now = {"slot": slots, "key": after["key"].gather(1, slots)}
        none = {"slot": torch.zeros_like(slots), "key": torch.full_like(slots, -1)}
        before = TensorDict(none, slots.shape) if self._before is None else self._before
        there = after["key"].gather(1, before["slot"]) == before["key"]  # not evicted since
        credited = torch.zeros_like(after["filled"]).scatter(1, before["slot"], there)
        after["score"] = after["score"] + self._co_learnability * fell * credited
        self._before = TensorDict(now, slots.shape).where(replayed.unsqueeze(-1), before)
        return after

    def _fresh(self, streams: Sequence[Streams], *purpose: str | int) -> Levels:
        """New levels [K, P] on the CPU."""
        return fresh_levels(self._new_levels, self.task.batch_size, streams, *purpose).cpu()

    def improve(self, learner: PPO, updates: int, streams: Sequence[Streams]) -> Improvement:
        """Tell of the last cycle: how much was replayed, and what the buffers are like."""
        if not len(self.buffer) or not bool(self.buffer["filled"].any()):
            return Improvement()
        buffer, filled = self.buffer, self.buffer["filled"]
        age = buffer["clock"] - buffer["touched"]
        shares = replay_weights(buffer["score"], age, filled, self._rule)
        count = filled.sum(-1)
        metrics = {
            "replayed": self._told["replayed"] / max(self._told["updates"], 1),
            "filled": count.tolist(),
            "effective_levels": (1 / shares.square().sum(-1)).tolist(),
            "mean_score": (buffer["score"].where(filled, 0).sum(-1) / count).tolist(),
            "mean_generation": (buffer["generation"].where(filled, 0).sum(-1) / count).tolist(),
            "levels": self._pictures(),
        }
        if self._last is not None:
            keys = level_keys(self._last["level"])
            metrics["distinct_levels"] = [len(own.unique()) for own in keys]
        self._told = {"updates": 0, "replayed": 0}
        return Improvement(metrics)

    def _pictures(self) -> dict[str, Any]:
        """Levels of the first Solver's buffer, to be looked at."""
        buffer = self.buffer[0][self.buffer["filled"][0]]
        shown = {
            "highest scores": buffer["score"].topk(min(SHOWN, len(buffer))).indices,
            "most replayed": buffer["draws"].topk(min(SHOWN, len(buffer))).indices,
        }
        if self._edits:
            shown["the longest line of edits in the buffer"] = _lineage(buffer)
        return {
            caption: self.task.record(buffer["level"][which], None)
            for caption, which in shown.items()
        }

    def state_dict(self) -> dict[str, Any]:
        """The buffers, and what is known of the last update."""
        state = {"buffer": self.buffer, "last": self._last, "before": self._before}
        return {
            **{
                name: None if td is None else td.clone().to_dict(convert_tensors=False)
                for name, td in state.items()
            },
            "scored": self._scored,
            "told": dict(self._told),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with them."""
        buffer, last, before = (
            None if state[name] is None else self._restored(state[name])
            for name in ("buffer", "last", "before")
        )
        assert buffer is not None
        self.buffer, self._last, self._before = buffer, last, before
        self._scored, self._told = state["scored"], dict(state["told"])

    def _restored(self, entries: Mapping[str, Any]) -> TensorDict:
        shape = entries["slot" if "slot" in entries else "filled"].shape
        restored = TensorDict.from_dict(dict(entries), batch_size=shape)
        if "level" in entries:
            kind = type(self._template)
            restored["level"] = kind.from_dict(entries["level"], batch_size=shape)
        return restored.clone()


def _easiness(scorer: Scorer, learner: PPO, update: Update) -> Tensor:
    """Mean absolute advantage minus mean return of levels [K, P]: what "easy" parents have most of.

    Of the published ones, those with the lowest return minus value loss (the authors' code, dcd).
    """
    found = episodes(update.rollout)
    loss = Scorer(scorer.task, "l1_value_loss", "episodes")
    lost = loss.of_rollouts(learner, [update.rollout], *unseen(found.ended.shape)).score
    return lost - (found.total / found.ended.clamp(1)).cpu()


def _lineage(buffer: TensorDictBase) -> Tensor:
    """Slots of a buffer [n] that hold the longest line of levels, each edited from the one before.

    At most the last :data:`SHOWN` of it.
    """
    place = {key: slot for slot, key in enumerate(buffer["key"].tolist())}
    parents = [place.get(key) for key in buffer["parent"].tolist()]
    longest: list[int] = []
    for slot in range(len(parents)):
        line, parent = [slot], parents[slot]
        while parent is not None and parent not in line and len(line) < SHOWN:
            line.append(parent)
            parent = parents[parent]
        longest = max(longest, line, key=len)
    return torch.tensor(longest[::-1])

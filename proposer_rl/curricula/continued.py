"""Episodes that go on from update to update: each gets a level, and is credited to it.

An update then trains on parts of episodes. Levels are proposed before it, as many as ended episodes
in the last one and one more for each environment; those that are left over come first in the next
update, the oldest being given up where there are too many. Where all are used up a level is played
again. What came of a level is known when its episode is over, an update or many later: the batch is
observed in parts, as soon as it is known which of its levels are played.

Of K students that train side by side a batch has a level each in every place, and it is observed
when the last of them is over; levels that one of them did not come to are left out.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, pad
from torch import Tensor

from proposer_rl.curricula.batches import device_of, moved, of_kind, packed
from proposer_rl.curricula.contract import Batch, Curriculum, outcome_of
from proposer_rl.curricula.ledger import Ledger
from proposer_rl.curricula.student import Student
from proposer_rl.learning import PPO, Update
from proposer_rl.streams import Streams
from proposer_rl.task import Levels

# Numbers of an observation that are kept with an episode, since pictures of tasks show where an
# agent was; what is larger, as images, takes most of the memory.
FEW = 16

Played = tuple[Levels, TensorDictBase]
"""Levels [K, m], and a rollout [K, m, T] with one episode on each."""

Credit = tuple[Batch, TensorDict]
"""A batch or a part of one, and its outcome."""


class ContinuedLevels:
    """Trains a learner whose episodes go on, on a curriculum's levels.

    Args:
        curriculum: that proposes.
        student: to whom.
        learner: PPO with ``continue_episodes``, of K Solvers in environments [K, P].
        like: levels of the task's kind, [n].
    """

    def __init__(
        self, curriculum: Curriculum, student: Student, learner: PPO, like: Levels
    ) -> None:
        assert learner.collector.episodes is not None  # which continue_episodes makes
        self._curriculum, self._student, self._learner = curriculum, student, learner
        self._episodes = learner.collector.episodes
        self._episodes.next_levels = self._next_levels
        students, count = learner.env.batch_size
        self._ledger = Ledger({"episode": object})
        self._at = [0] * students  # the next id of each; what is from there on waits
        self._levels = like[:1].expand(students, count).clone()  # that are played, or set
        self._playing = [[-1] * count for _ in range(students)]
        self._over: dict[tuple[int, int], list[int]] = defaultdict(list)
        self._most = count  # episodes of a student that ended in an update
        self._steps = torch.zeros(students, count, dtype=torch.int64)  # of the present episodes
        self._history: TensorDictBase | None = None  # [K, P, H], which ends with the last update
        self._shown: Played | None = None

    def update(self, streams: Sequence[Streams]) -> tuple[Update, list[Credit]]:
        """Makes one update, whose actions and levels are drawn from K streams of its own.

        Returns:
            The update, and what is to be observed now.
        """
        self._propose(streams)
        update = self._learner.update([stream.generator("actions") for stream in streams])
        self._learner.check()
        self._cut(update.rollout)
        credits = [
            (batch, outcome_of_episodes(results["episode"].tolist()))
            for batch, results in self._ledger.take(settled=True)
        ]
        if credits:
            batch, outcome = credits[-1]
            self._shown = batch.levels, outcome["rollout"]
        return update, credits

    def _propose(self, streams: Sequence[Streams]) -> None:
        count = self._steps.shape[1]
        wanted = count + self._most - (self._ledger.next - max(self._at))
        batch = self._curriculum.propose(self._student, max(wanted, 1), streams)
        for student, at in enumerate(self._at):
            self._at[student] = max(at, self._ledger.next - count)
            for id in range(at, self._at[student]):
                self._ledger.drop_one(id, student)
        self._ledger.add(batch)

    def _next_levels(self, begins: Tensor) -> Levels:
        """Returns the levels [K, P] that are played from now on, new ones where episodes begin.

        Args:
            begins: where they do, bool [K, P].
        """
        if self._episodes.fresh:
            self._forget()
        for student, env in begins.nonzero().tolist():
            self._over[student, env].append(self._playing[student][env])
            if self._at[student] < self._ledger.next:
                id = self._playing[student][env] = self._at[student]
                self._at[student] += 1
                self._levels[student, env] = self._ledger.hand_out(id, student)
        if self._episodes.fresh:
            self._over.clear()  # what had been played before has no end
        return self._levels

    def _forget(self) -> None:
        """Drops the episodes that have been broken off."""
        for student, row in enumerate(self._playing):
            for id in row:
                self._ledger.drop_one(id, student)
        self._history, self._steps = None, torch.zeros_like(self._steps)

    def _cut(self, rollout: TensorDictBase) -> None:
        """Notes the episodes that ended in a rollout [K, P, T], and keeps what has not ended."""
        kept = rollout.exclude("advantage", "value_target")
        if "policy_gradient_norms" not in self._curriculum.needs:  # which reads what was seen
            seen = self._learner.agent.step_keys
            large = [key for key in seen if kept.get(key).shape[3:].numel() > FEW]
            kept = kept.exclude(*large, *(("next", key) for key in large))
        history = kept if self._history is None else torch.cat([self._history, kept], 2)
        before, length = history.shape[2] - rollout.shape[2], history.shape[2]
        begun = before - self._steps
        ends = rollout["next", "done"].squeeze(-1).nonzero()
        for student, env, step in ends.tolist():
            id = self._over[student, env].pop(0)
            end = before + step + 1
            episode = history[student, env, int(begun[student, env]) : end]
            begun[student, env] = end
            if self._ledger.is_out(id, student):  # further episodes on a level do not count
                self._ledger.tell_one(id, {"episode": episode.clone()}, student)
        self._most = int(ends[:, 0].bincount(minlength=1).max())
        self._steps = length - begun
        self._history = history[:, :, length - int(self._steps.max()) :].clone()

    @property
    def shown(self) -> Played:
        """Returns the levels that were observed last, and the episodes on them [K, m, T].

        Before anything was observed these are the levels that are played, without a step (T = 0).
        """
        assert self._history is not None  # after an update
        return self._shown or (self._levels, self._history[:, :, :0])

    def state_dict(self) -> dict[str, Any]:
        """Returns all that a resumed run needs, with the actions of episodes that are not over."""
        memory = self._learner.collector.memory
        discounted = self._learner.statistics.discounted
        return {
            "at": list(self._at),
            "levels": packed(self._levels),
            "playing": [list(row) for row in self._playing],
            "most": self._most,
            "steps": self._steps.clone(),
            "history": None if self._history is None else packed(self._history),
            "memory": None if memory is None else packed(memory),
            "discounted": None if discounted is None else discounted.clone(),
            "shown": None if self._shown is None else [*map(packed, self._shown)],
            "ledger": self._ledger.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Puts back a state, and plays episodes that are not over again up to where they were.

        Tensors of a checkpoint are on the CPU; those that meet the learner's go to its device.
        """
        device = self._learner.env.device
        self._most = state["most"]
        self._at = list(state["at"])
        self._levels = _of_kind(self._levels, state["levels"])
        self._playing = [list(row) for row in state["playing"]]
        self._steps = state["steps"].clone()
        self._ledger.load_state_dict(state["ledger"], self._levels, device)
        self._history = self._shown = None
        if state["shown"] is not None:
            levels, episodes = state["shown"]
            self._shown = (
                _of_kind(self._levels, levels),
                TensorDict.from_dict(episodes, batch_dims=3).to(device),
            )
        if state["history"] is not None:
            self._history = TensorDict.from_dict(state["history"], batch_dims=3).to(device)
            self._episodes.stand(self._levels, self._history["action"], self._steps)
        if state["discounted"] is not None:
            self._learner.statistics.discounted = state["discounted"].clone().to(device)
        if state["memory"] is not None:
            memory = TensorDict.from_dict(state["memory"], batch_dims=2)
            self._learner.collector.memory = memory.to(device)


def _of_kind(like: Levels, state: Mapping[str, Any]) -> Levels:
    """Returns levels of the class and on the device of others, from nested dicts."""
    return moved(of_kind(like, state), device_of(like))


def outcome_of_episodes(episodes: Sequence[Sequence[TensorDictBase]]) -> TensorDict:
    """Returns the outcome of levels [K, m] by the one episode [T] that was played on each.

    Episodes are filled up with zeros to one rollout [K, m, T], whose ``is_step`` marks real steps.
    """
    longest = max(len(episode) for row in episodes for episode in row)

    def filled_up(episode: TensorDictBase) -> Any:
        played = torch.ones(len(episode), dtype=torch.bool, device=episode["action"].device)
        return pad(episode.copy().set("is_step", played), [0, longest - len(episode)])

    rows: list[Any] = [torch.stack([filled_up(each) for each in row]) for row in episodes]
    return outcome_of(torch.stack(rows))

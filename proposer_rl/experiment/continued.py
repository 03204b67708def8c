"""Assigns levels to episodes that go on from update to update, and credits results to levels.

An update trains on parts of episodes. Before it, the curriculum proposes as many levels as episodes
ended in the last update, and one more for each environment. Unused levels come first in the next
update; the oldest are given up if there are too many. If all are used up, a level is played again.
The result of a level is known when its episode ends, in this update or many updates later. So a
batch is observed in parts, as soon as it is known which of its levels are played.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula.batches import packed, unpacked
from proposer_rl.curricula.contract import Batch, Curriculum, outcome_of_episodes, proposed
from proposer_rl.curricula.ledger import Ledger
from proposer_rl.curricula.student import Student
from proposer_rl.learning import PPO, Update
from proposer_rl.streams import Streams
from proposer_rl.task import Levels

# Observations of up to this many numbers are kept with an episode, because pictures show where an
# agent was; larger ones, such as images, would take most of the memory.
FEW = 16

Played = tuple[Levels, TensorDictBase]
"""Levels [m], and a rollout [m, T] with one episode on each."""

Credit = tuple[Batch, TensorDict]
"""A batch or a part of one, and its outcome."""


class Queue:
    """The levels of one Solver whose episodes go on: waiting, being played, or over.

    Args:
        curriculum: proposes the levels.
        student: to whom it proposes.
        like: a level of the task's kind, [].
        count: number P of environments.
    """

    def __init__(self, curriculum: Curriculum, student: Student, like: Levels, count: int) -> None:
        self.curriculum, self._student = curriculum, student
        self._ledger = Ledger({"episode": object})
        self._at = 0  # the next id to play; later ones wait
        self.levels = like.unsqueeze(0).expand(count).clone()  # that are played, or set
        self._playing = [-1] * count
        self._over: dict[int, list[int]] = defaultdict(list)
        self._most = count  # episodes that ended in the last update
        self.steps = torch.zeros(count, dtype=torch.int64)  # of the present episodes

    def propose(self, rng: Streams) -> None:
        """Lets the curriculum propose as many levels as the next update may need."""
        count, ledger = len(self._playing), self._ledger
        wanted = max(count + self._most - (ledger.next - self._at), 1)
        batch = proposed(self.curriculum, self._student, wanted, rng)
        first = max(self._at, ledger.next - count)
        for id in range(self._at, first):
            ledger.drop_one(id)
        self._at = first
        ledger.add(batch)

    def begin(self, envs: Sequence[int], *, fresh: bool) -> None:
        """Gives the next levels to environments whose episodes begin.

        Args:
            envs: their places.
            fresh: whether all episodes begin anew, and those before are abandoned.
        """
        if fresh:
            for id in self._playing:
                self._ledger.drop_one(id)
            self.steps = torch.zeros_like(self.steps)
        for env in envs:
            self._over[env].append(self._playing[env])
            if self._at < self._ledger.next:
                id = self._playing[env] = self._at
                self._at += 1
                self.levels[env] = self._ledger.hand_out(id)
        if fresh:
            self._over.clear()

    def cut(self, history: TensorDictBase, before: int, ends: Sequence[Sequence[int]]) -> None:
        """Records the episodes that ended.

        Args:
            history: steps [P, H]; those of the update begin at ``before``.
            before: a place in the history.
            ends: environment and step within the update of each end.
        """
        begun = before - self.steps
        for env, step in ends:
            id = self._over[env].pop(0)
            end = before + step + 1
            episode = history[env, int(begun[env]) : end]
            begun[env] = end
            if self._ledger.is_out(id):  # further episodes on a level do not count
                is_step = torch.ones(
                    len(episode), dtype=torch.bool, device=episode["action"].device
                )
                self._ledger.tell_one(id, {"episode": episode.clone().set("is_step", is_step)})
        self._most = len(ends)
        self.steps = history.shape[1] - begun

    def credits(self) -> list[Credit]:
        """Returns the batches, or parts of them, that are to be observed now."""
        return [
            (batch, outcome_of_episodes(results["episode"].tolist()))
            for batch, results in self._ledger.take(settled=True)
        ]

    def state_dict(self) -> dict[str, Any]:
        """Returns the whole queue."""
        return {
            "at": self._at,
            "levels": packed(self.levels),
            "playing": list(self._playing),
            "most": self._most,
            "steps": self.steps.clone(),
            "ledger": self._ledger.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any], device: torch.device | None) -> None:
        """Restores what :meth:`state_dict` returned, with episodes on this device."""
        self._at, self._most = state["at"], state["most"]
        self.levels = unpacked(state["levels"], self.levels)
        self._playing, self.steps = list(state["playing"]), state["steps"].clone()
        self._ledger.load_state_dict(state["ledger"], self.levels, device)


class ContinuedLevels:
    """Trains K Solvers whose episodes go on, each on the levels of its own curriculum.

    Args:
        curricula: one for each Solver.
        students: to whom they propose.
        learner: PPO with ``continue_episodes``, of the Solvers in environments [K, P].
        like: a level of the task's kind, [].
    """

    def __init__(
        self,
        curricula: Sequence[Curriculum],
        students: Sequence[Student],
        learner: PPO,
        like: Levels,
    ) -> None:
        assert learner.collector.episodes is not None  # which continue_episodes makes
        self._learner, self._episodes = learner, learner.collector.episodes
        self._episodes.next_levels = self._next_levels
        self._queues = [
            Queue(curriculum, student, like, learner.env.batch_size[1])
            for curriculum, student in zip(curricula, students, strict=True)
        ]
        # If one of them needs observations, they are kept for all.
        self._keeps_seen = any("policy_gradient_norms" in each.needs for each in curricula)
        self._history: TensorDictBase | None = None  # [K, P, H], which ends with the last update
        self._shown: list[Played | None] = [None] * len(self._queues)

    def update(self, rngs: Sequence[Streams]) -> tuple[Update, list[list[Credit]]]:
        """Makes one update, with actions and levels from K streams.

        Returns:
            The update, and the batches that each curriculum has to observe now.
        """
        for queue, rng in zip(self._queues, rngs, strict=True):
            queue.propose(rng)
        update = self._learner.update([rng.generator("actions") for rng in rngs])
        self._learner.check()
        self._cut(update.rollout)
        credits = [queue.credits() for queue in self._queues]
        for k, own in enumerate(credits):
            if own:
                batch, outcome = own[-1]
                self._shown[k] = batch.levels, outcome["rollout"]
        return update, credits

    def _next_levels(self, begins: Tensor) -> Levels:
        """Returns the levels [K, P] to play from now on, new ones where episodes begin.

        Args:
            begins: where they do, bool [K, P].
        """
        if self._episodes.fresh:
            self._history = None
        for queue, own in zip(self._queues, begins, strict=True):
            queue.begin(own.nonzero().flatten().tolist(), fresh=self._episodes.fresh)
        return torch.stack([queue.levels for queue in self._queues])

    def _cut(self, rollout: TensorDictBase) -> None:
        """Records the episodes that ended in a rollout [K, P, T], and keeps unfinished ones."""
        kept = rollout.exclude("advantage", "value_target")
        if not self._keeps_seen:
            seen = self._learner.agent.step_keys
            large = [key for key in seen if kept.get(key).shape[3:].numel() > FEW]
            kept = kept.exclude(*large, *(("next", key) for key in large))
        history = kept if self._history is None else torch.cat([self._history, kept], 2)
        before = history.shape[2] - rollout.shape[2]
        done = rollout["next", "done"].squeeze(-1)
        for queue, own, ended in zip(self._queues, history, done, strict=True):
            queue.cut(own, before, ended.nonzero().tolist())
        longest = max(int(queue.steps.max()) for queue in self._queues)
        self._history = history[:, :, history.shape[2] - longest :].clone()

    @property
    def shown(self) -> list[Played]:
        """Each Solver's last observed levels, with the episodes on them.

        Before the first observation these are the levels being played, without steps (T = 0).
        """
        assert self._history is not None  # after an update
        each = zip(self._shown, self._queues, self._history, strict=True)
        return [shown or (queue.levels, own[:, :0]) for shown, queue, own in each]

    def state_dict(self) -> dict[str, Any]:
        """Returns all that a resumed run needs, with the actions of unfinished episodes."""
        memory = self._learner.collector.memory
        discounted = self._learner.statistics.discounted
        return {
            "queues": [queue.state_dict() for queue in self._queues],
            "history": None if self._history is None else packed(self._history),
            "memory": None if memory is None else packed(memory),
            "discounted": None if discounted is None else discounted.clone(),
            "shown": [None if own is None else [*map(packed, own)] for own in self._shown],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores a state, and replays unfinished episodes up to where they were.

        Tensors of a checkpoint are on the CPU; those that the learner uses move to its device.
        """
        device = self._learner.env.device
        for queue, own in zip(self._queues, state["queues"], strict=True):
            queue.load_state_dict(own, device)
        self._history = None
        for k, shown in enumerate(state["shown"]):
            self._shown[k] = None
            if shown is not None:
                levels, episodes = shown
                self._shown[k] = (
                    unpacked(levels, self._queues[k].levels),
                    TensorDict.from_dict(episodes, batch_dims=2).to(device),
                )
        if state["history"] is not None:
            self._history = TensorDict.from_dict(state["history"], batch_dims=3).to(device)
            levels = torch.stack([queue.levels for queue in self._queues])
            steps = torch.stack([queue.steps for queue in self._queues])
            self._episodes.stand(levels, self._history["action"], steps)
        if state["discounted"] is not None:
            self._learner.statistics.discounted = state["discounted"].clone().to(device)
        if state["memory"] is not None:
            memory = TensorDict.from_dict(state["memory"], batch_dims=2)
            self._learner.collector.memory = memory.to(device)

"""The meta-environment: one step trains K Solvers on proposed levels, and observes them.

From top to bottom: what is trained (:class:`Learner`), how a Proposer sees it
(:class:`SolverView`), and the environment itself.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.utils import make_composite_from_td

from proposer_rl.learning import Update, located
from proposer_rl.meta.actions import Actions
from proposer_rl.meta.rewards import Reward, TrainingStep, mean_log_success, mean_return
from proposer_rl.models import ActorCritic
from proposer_rl.settings import ArgumentError, signed
from proposer_rl.streams import Streams
from proposer_rl.task import Task


class Learner(Protocol):
    """The interface of K learners, each of which trains on P levels in every update.

    Each trains as if it were alone. :class:`~proposer_rl.learning.PPO` of a population is a
    learner; ``examples/own_learner.py`` shows another kind.

    Attributes:
        env: with ``batch_size`` [K, P], ``device``, and ``set_levels(levels [K, P])``, which sets
            the levels of the next update.
        agent: argument of the task's ``performance`` and ``probe``.
        copies: the number K.
        horizon: environment steps of an update on one level.
    """

    env: Any
    agent: Any

    @property
    def copies(self) -> int | None: ...  # noqa: D102

    @property
    def horizon(self) -> int: ...  # noqa: D102

    def update(self, generators: list[torch.Generator]) -> Update:
        """Trains on the levels that were set; learner k draws from the k-th generator."""

    def check(self, first: int = 0) -> None:
        """Raises a DivergedError if a number of the last update is not finite.

        Args:
            first: number of the first learner, for naming learners.
        """

    def snapshot(self) -> TensorDict:
        """Copies all that an update changes, batch [K]."""

    def restore(self, snapshot: TensorDictBase) -> None:
        """Restores a snapshot [K]."""


class SolverView:
    """Observes Solvers for a Proposer: performance and outputs on target levels.

    The validation levels, on which performance is measured, and the probe levels, on which outputs
    are shown, are drawn anew for every cycle.

    Args:
        task: provides the target distribution, and evaluates Solvers on its levels.
        validation_levels: number E of levels on which performance is measured.
        probe_levels: number C of levels on which outputs are shown.
    """

    def __init__(self, task: Task, *, validation_levels: int, probe_levels: int) -> None:
        self.task = task
        self.validation_levels, self.probe_levels = validation_levels, probe_levels
        self.draw_levels(Streams(0))

    def draw_levels(self, streams: Streams) -> None:
        """Draws the validation and probe levels of a cycle from its random streams."""
        self.streams = streams
        target = self.task.target
        self.validation = target.sample(self.validation_levels, streams.generator("validation"))
        self.probes = target.sample(self.probe_levels, streams.generator("probes"))

    @torch.no_grad()
    def performance(self, agent: ActorCritic, *place: int) -> TensorDictBase:
        """Measures K Solvers on the validation levels: a tensordict [K, E].

        A task that evaluates by playing draws from a separate stream for every ``place``, numbers
        that identify an evaluation within a cycle.
        """
        generator = self.streams.generator("evaluation", *place)
        return self.task.performance(agent, self.validation, generator)

    @torch.no_grad()
    def probe(self, agent: ActorCritic) -> Tensor:
        """Returns the outputs of K Solvers on the probe levels, float [K, C, ...]."""
        return self.task.probe(agent, self.probes)

    def observation(
        self, performance: TensorDictBase, probes: Tensor, progress: float
    ) -> TensorDict:
        """Makes the Proposer's observation of K Solvers.

        Args:
            performance: on the validation levels, [K, E].
            probes: float [K, C, ...].
            progress: the elapsed part of the meta-episode, in [0, 1].

        Returns:
            A tensordict [K] of ``probes`` float [K, C, ...], and of numbers float [K, 1]: the mean
            ``return`` over the validation levels, ``log_success`` likewise if the task has a
            success, and ``progress``.
        """
        numbers = {"return": mean_return(performance)}
        if "success" in performance.keys():
            numbers["log_success"] = mean_log_success(performance)
        numbers["progress"] = torch.full_like(numbers["return"], progress)
        columns = {name: number.unsqueeze(-1) for name, number in numbers.items()}  # [K, 1]
        return TensorDict({"probes": probes, **columns}, probes.shape[:1], device=self.task.device)

    def observe(self, agent: ActorCritic, progress: float, *place: int) -> TensorDict:
        """Evaluates K Solvers, and returns their :meth:`observation`."""
        return self.observation(self.performance(agent, *place), self.probe(agent), progress)


@signed
class SolverTrainingEnv(EnvBase):
    """Trains K Solvers as a batch of K episodes (the paper's section 5).

    An action defines P levels for each Solver. A step generates the levels, updates each Solver on
    its own ones, and observes it. An episode has ``meta_episode_length`` updates of Solvers that
    all start as the one given to :meth:`fork`. The environment works with any kind of level.

    An action may be repeated for several updates, each on fresh levels. The episode then has fewer
    steps, the Solvers are evaluated only between them, and the effect of an action is easier to
    distinguish from chance.

    Observations: those of :meth:`SolverView.observation`, and ``proposed`` int64 [K, N], how often
    each bin was drawn in the last step. Actions: ``action``, as ``actions`` defines them. Episodes
    end by ``terminated``.

    Args:
        solvers: the K Solvers, which train side by side.
        view: observes the Solvers, and has the validation levels on which the gain is measured.
        actions: turns actions into levels.
        reward: returns a number for each Solver and update; a step's reward is the sum over its
            updates.
        meta_episode_length: number L of updates in an episode.
        action_repeat: number of updates for which an action holds; divides L.
        first_replica: number of the first of these Solvers if others train elsewhere; random
            numbers belong to the number of a replica.
        on_update: called after every update with the number of updates in the episode so far, e.g.
            for a progress bar; an exception ends the episode.

    Raises:
        ValueError: if ``action_repeat`` does not divide L.
        ArgumentError: in a step, if the reward is not one number for each Solver.
    """

    def __init__(
        self,
        solvers: Learner,
        *,
        view: SolverView,
        actions: Actions,
        reward: Reward,
        meta_episode_length: int,
        action_repeat: int = 1,
        first_replica: int = 0,
        on_update: Callable[[int], None] | None = None,
    ) -> None:
        if min(meta_episode_length, action_repeat) < 1 or meta_episode_length % action_repeat:
            raise ValueError(
                f"action_repeat={action_repeat} must divide "
                f"meta_episode_length={meta_episode_length}"
            )
        assert solvers.copies is not None  # a population
        self._replicas = range(first_replica, first_replica + solvers.copies)
        super().__init__(device=solvers.env.device, batch_size=[len(self._replicas)])
        self.solvers, self.view, self.actions = solvers, view, actions
        self.meta_episode_length, self.action_repeat = meta_episode_length, action_repeat
        self._reward, self.on_update = reward, on_update or (lambda done: None)
        self.fork(solvers.snapshot()[0], Streams(0))
        self._make_specs()

    @property
    def steps(self) -> int:
        """The number of steps, that is of actions, in an episode."""
        return self.meta_episode_length // self.action_repeat

    @property
    def batch_of_levels(self) -> int:
        """The number P of levels in an update."""
        return int(self.solvers.env.batch_size[1:].numel())

    def fork(self, solver: TensorDictBase, streams: Streams) -> None:
        """Starts the next episodes from one Solver, with new validation and probe levels.

        Args:
            solver: a snapshot of it, batch [] (weights and Adam's state).
            streams: random streams for the levels and the Solvers' actions.
        """
        self.streams = streams
        self.view.draw_levels(streams)
        self._origin = solver.expand(len(self._replicas))
        self.solvers.restore(self._origin)
        self._episode = -1
        self._updates = 0
        self._origin_seen = self._performance(), self.view.probe(self.solvers.agent)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDictBase:
        # Only marks the start: a collector resets as soon as an episode ends, and the trained
        # Solvers must stay readable until the next one really begins.
        self._updates = 0
        none_yet = torch.zeros(*self.batch_size, self.actions.bins, dtype=torch.int64)
        return self._observation(*self._origin_seen, none_yet.to(self.device))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self._updates == 0:
            self.solvers.restore(self._origin)
            self._seen = self._origin_seen
            self._episode += 1
        rewards, choices = [], []
        for update in range(self.action_repeat):
            last = update == self.action_repeat - 1
            reward, chosen = self._train(tensordict["action"], measure=last)
            rewards.append(reward)
            choices.append(chosen)
            self.on_update(self._updates)
        drawn = torch.cat(choices, -1)  # [K, updates * P]
        counts = drawn.new_zeros(*self.batch_size, self.actions.bins)  # [K, N]
        proposed = counts.scatter_add_(1, drawn, torch.ones_like(drawn)).to(self.device)
        state = self._observation(*self._seen, proposed)
        return state.set("reward", torch.stack(rewards).sum(0).unsqueeze(-1))

    def _train(self, action: Tensor, *, measure: bool) -> tuple[Tensor, Tensor]:
        """Updates every Solver; returns the rewards [K] and the drawn bins [K, P]."""
        streams = [self.streams.within(self._episode, self._updates, k) for k in self._replicas]
        levels, choices = self.actions.levels(action, self.batch_of_levels, streams)
        self.solvers.env.set_levels(levels)
        generators = [stream.generator("actions") for stream in streams]
        # A collector steps its environment without gradients, but Solvers learn here.
        place = f"update {self._updates} of the episode of the Solver's copies"
        with torch.enable_grad(), located(place):
            update = self.solvers.update(generators)
            self.solvers.check(self._replicas.start)
        self._updates += 1
        before, _ = self._seen
        if measure:
            self._seen = self._performance(), self.view.probe(self.solvers.agent).clone()
        step = TrainingStep(levels, update.rollout, self.solvers.agent, before, self._seen[0])
        reward = torch.as_tensor(self._reward(step))
        if reward.shape != self.batch_size:
            raise ArgumentError(
                f"reward: must be a number for each Solver, of shape {list(self.batch_size)}, got "
                f"shape {list(reward.shape)}"
            )
        return reward, choices

    def _set_seed(self, seed: int | None) -> None:
        self.streams, self._episode = Streams(seed or 0), -1

    def _performance(self) -> TensorDictBase:
        return self.view.performance(self.solvers.agent, self._episode, self._updates)

    def _observation(
        self, performance: TensorDictBase, probes: Tensor, proposed: Tensor
    ) -> TensorDict:
        progress = self._updates / self.meta_episode_length
        over = self._updates == self.meta_episode_length
        ended = torch.full((*self.batch_size, 1), over, dtype=torch.bool, device=self.device)
        state = self.view.observation(performance, probes, progress)
        return state.update({"proposed": proposed, "terminated": ended, "done": ended.clone()})

    def _make_specs(self) -> None:
        flags = ("terminated", "done")
        state = self._reset()
        self.observation_spec = make_composite_from_td(state.exclude(*flags))
        self.action_spec = self.actions.spec(self.batch_size[0], self.batch_of_levels, self.device)
        like = state["return"]
        self.reward_spec = Unbounded(like.shape, dtype=like.dtype, device=self.device)
        flag = Categorical(2, shape=(*self.batch_size, 1), dtype=torch.bool, device=self.device)
        self.done_spec = Composite({key: flag.clone() for key in flags}, shape=self.batch_size)


def action_generators(streams: Streams, replicas: range) -> list[torch.Generator]:
    """Returns a generator of the Proposer's actions for each of these replicas."""
    return [streams.generator("proposals", replica) for replica in replicas]

"""The meta-environment: one step trains K Solvers on proposed levels."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.utils import make_composite_from_td

from proposer_rl.learning import located
from proposer_rl.meta.actions import Actions
from proposer_rl.meta.learner import Learner
from proposer_rl.meta.rewards import Reward, TrainingStep
from proposer_rl.meta.view import SolverView
from proposer_rl.settings import ArgumentError, signed
from proposer_rl.streams import Streams


@signed
class SolverTrainingEnv(EnvBase):
    """Training K Solvers as a batch of K episodes (section 5 of the paper).

    An action says what the P levels of an update are to be; the step generates them, trains each
    Solver on its own, and observes it. An episode is ``meta_episode_length`` updates of Solvers
    that all start as the one given to :meth:`fork`. Nothing here knows what a level is.

    An action may be repeated for several updates, each on fresh levels. The episode then has fewer
    steps, the Solvers are evaluated only between them, and what an action led to is more easily
    told from chance.

    Observations: those of :meth:`~proposer_rl.meta.view.SolverView.observation`, and ``proposed``
    int64 [K, N], how often each bin was drawn in the step before. Actions: ``action``, as
    ``actions`` defines them. Episodes end by ``terminated``.

    Args:
        solvers: K of them; see :class:`~proposer_rl.meta.learner.Learner`.
        view: what is seen of the Solvers, and the validation levels that the gain is measured on.
        actions: the levels that an action stands for.
        reward: of an update; that of a step is the sum over its updates.
        meta_episode_length: updates L of an episode.
        action_repeat: updates for which an action holds; divides L.
        first_copy: number of the first of these Solvers, where others are trained elsewhere: a
            copy's random numbers belong to its number.
        on_update: called after every update with the number of those that the episode has had,
            e.g. by a progress bar; what it raises ends the episode.

    Attributes:
        last_training: levels [K, P] of the last update, and what came of it.

    Raises:
        ValueError: if the Solvers are no population, or a length is out of range.
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
        first_copy: int = 0,
        on_update: Callable[[int], None] | None = None,
    ) -> None:
        if solvers.copies is None:
            raise ValueError("the Solvers must be a population: their agent has no copies")
        if min(meta_episode_length, action_repeat) < 1 or meta_episode_length % action_repeat:
            raise ValueError(
                f"action_repeat={action_repeat} must divide "
                f"meta_episode_length={meta_episode_length}"
            )
        self._copies = range(first_copy, first_copy + solvers.copies)
        super().__init__(device=solvers.env.device, batch_size=[len(self._copies)])
        self.solvers = solvers
        self.view = view
        self.actions = actions
        self.meta_episode_length = meta_episode_length
        self.action_repeat = action_repeat
        self._reward = reward
        self.on_update = on_update or (lambda done: None)
        self.fork(solvers.snapshot()[0], Streams(0))
        self._make_specs()

    @property
    def steps(self) -> int:
        """Steps, that is actions, of an episode."""
        return self.meta_episode_length // self.action_repeat

    @property
    def batch_of_levels(self) -> int:
        """Levels P of an update."""
        return int(self.solvers.env.batch_size[1:].numel())

    @property
    def frames_per_update(self) -> int:
        """Environment steps of one Solver's update."""
        return self.batch_of_levels * self.solvers.horizon

    def fork(self, solver: TensorDictBase, streams: Streams) -> None:
        """Start the next episodes from copies of one Solver, on new validation and probe levels.

        Args:
            solver: a snapshot of one Solver, batch [] (weights and Adam's state).
            streams: where the randomness of the levels and of the Solvers' actions comes from.
        """
        self.streams = streams
        self.view.draw_levels(streams)
        self._origin = solver.expand(len(self._copies))
        self.solvers.restore(self._origin)
        self._episode = -1
        self._updates = 0
        self._origin_seen = self._performance(), self.view.probe(self.solvers.agent)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDictBase:
        # Only marks the start: a collector resets as soon as an episode has ended, and the trained
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
            reward, drawn = self._train(tensordict["action"], measure=last)
            rewards.append(reward)
            choices.append(drawn)
            self.on_update(self._updates)
        proposed = _count(torch.cat(choices, -1), self.actions.bins).to(self.device)
        state = self._observation(*self._seen, proposed)
        return state.set("reward", torch.stack(rewards).sum(0).unsqueeze(-1))

    def _train(self, action: Tensor, *, measure: bool) -> tuple[Tensor, Tensor]:
        """One update of every Solver: its reward [K], and the bins that were drawn [K, P]."""
        streams = [self.streams.within(self._episode, self._updates, k) for k in self._copies]
        levels, choices = self.actions.levels(action, self.batch_of_levels, streams)
        self.solvers.env.set_levels(levels)
        generators = [stream.generator("actions") for stream in streams]
        # A collector steps its environment without gradients; this one learns inside.
        place = f"update {self._updates} of the episode of the Solver's copies"
        with torch.enable_grad(), located(place):
            update = self.solvers.update(generators)
            self.solvers.check(self._copies.start)
        self.last_training = (levels, update)
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
        told = state["return"]
        self.reward_spec = Unbounded(told.shape, dtype=told.dtype, device=self.device)
        flag = Categorical(2, shape=(*self.batch_size, 1), dtype=torch.bool, device=self.device)
        self.done_spec = Composite({key: flag.clone() for key in flags}, shape=self.batch_size)


def action_generators(streams: Streams, copies: range) -> list[torch.Generator]:
    """Of the Proposer's actions on copies of a cycle, each of which has its number."""
    return [streams.generator("proposals", copy) for copy in copies]


def _count(choices: Tensor, size: int) -> Tensor:
    """How often each of ``size`` bins occurs along the last dimension, int64 [K, size]."""
    counts = choices.new_zeros(choices.shape[0], size)
    return counts.scatter_add_(1, choices, torch.ones_like(choices))

"""The meta-environment: one step trains K Solvers on proposed levels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from proposer_rl.learning.divergence import located
from proposer_rl.learning.ppo import PPO
from proposer_rl.meta.actions import Proposals
from proposer_rl.meta.rewards import Reward, TrainingStep
from proposer_rl.meta.view import SolverView
from proposer_rl.streams import Streams


class ReplayError(RuntimeError):
    """An interrupted episode cannot go on: its agent now chooses other actions."""


class SolverTrainingEnv(EnvBase):
    """Training K Solvers as a batch of K episodes (section 5 of the paper).

    An action says what the P levels of an update are to be; the step generates them, trains each
    Solver on its own, and observes it. An episode is ``episode_length`` updates of Solvers that all
    start as the one given to :meth:`fork`. Nothing here knows what a level is.

    An action may hold for several updates, each on fresh levels. The episode then has fewer steps,
    the Solvers are looked at only between them, and what an action led to is more easily told from
    chance.

    Observations: ``probes`` float [K, C, ...], ``validation_return`` float [K, 1], the mean return
    on the validation levels, ``progress`` float [K, 1], the part of the episode that is over, and
    ``proposed`` int64 [K, N], how often each choice was made in the step before. Actions:
    ``action``, as ``proposals`` defines them. Episodes end by ``terminated``.

    Args:
        solvers: K Solvers and their environment, batch [K, P], with a method ``set_levels``.
        view: what is seen of the Solvers, and the validation levels that the gain is measured on.
        proposals: the levels that an action stands for.
        reward: what an update is worth; a step is worth the sum of its updates.
        episode_length: updates L of an episode.
        updates_per_step: updates for which an action holds; divides L.
        common_random_numbers: whether all copies draw the same numbers, so that they differ by
            their actions alone; else every copy has its own.
        on_step: called after every update, e.g. by a progress bar.

    Raises:
        ValueError: if the Solvers are no population, or a length is out of range.
    """

    def __init__(
        self,
        solvers: PPO,
        *,
        view: SolverView,
        proposals: Proposals,
        reward: Reward,
        episode_length: int = 50,
        updates_per_step: int = 1,
        common_random_numbers: bool = False,
        on_step: Callable[[], None] | None = None,
    ) -> None:
        if solvers.agent.copies is None:
            raise ValueError("the Solvers must be a population: their agent has no copies")
        if min(episode_length, updates_per_step) < 1 or episode_length % updates_per_step:
            raise ValueError(
                "episode_length must be a positive multiple of updates_per_step; got "
                f"{episode_length} and {updates_per_step}"
            )
        self._copies = solvers.agent.copies
        super().__init__(device=solvers.env.device, batch_size=[self._copies])
        self.solvers = solvers
        self.view = view
        self.proposals = proposals
        self.episode_length = episode_length
        self.updates_per_step = updates_per_step
        self.common_random_numbers = common_random_numbers
        self._reward = reward
        self._on_step = on_step or (lambda: None)
        self.fork(solvers.snapshot()[0], Streams(0))
        self._make_specs()

    @property
    def steps(self) -> int:
        """Steps, that is actions, of an episode."""
        return self.episode_length // self.updates_per_step

    def fork(
        self, solver: TensorDictBase, streams: Streams, pause: Callable[[], None] | None = None
    ) -> None:
        """Start the next episodes from copies of one Solver, on new validation and probe levels.

        Args:
            solver: a snapshot of one Solver, batch [] (weights and Adam's state).
            streams: where the randomness of the levels and of the Solvers' actions comes from.
            pause: called between two updates, where :meth:`episode` is all that is needed to go on.
        """
        self.streams = streams
        self.view.draw_levels(streams)
        self._origin = solver.expand(self._copies)
        self.solvers.restore(self._origin)
        self._episode = -1
        self._updates = 0
        self._pause = pause or (lambda: None)
        self._taken: list[dict[str, Tensor]] = []  # what came of the present episode's updates
        self._replaying = False
        self._origin_return = self._validation_return()
        self._origin_probes = self.view.see(self.solvers.agent)

    def episode(self) -> dict[str, Any] | None:
        """What is needed to go on with the present episode; None between episodes."""
        if self._updates == 0:
            return None
        solvers = self.solvers.snapshot().to_dict()
        return {"number": self._episode, "updates": self._taken, "solvers": solvers}

    def resume(self, episode: dict[str, Any]) -> None:
        """Go on with an interrupted episode of the same fork, which has just been repeated.

        The episode is then played from its beginning. What came of the updates before the
        interruption is remembered instead of trained again. Where the agent chooses another action
        than then, which rounding can bring about on another machine, it gets a ReplayError.

        Args:
            episode: what :meth:`episode` returned.
        """
        # Choices stay where they are made, on the host.
        self._taken = [
            {key: x if key == "choices" else x.to(self.device) for key, x in taken.items()}
            for taken in episode["updates"]
        ]
        self._replaying = True
        self._episode = episode["number"]
        self.solvers.restore(TensorDict(episode["solvers"], self.batch_size).to(self.device))

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDictBase:
        # Only marks the start: a collector resets as soon as an episode has ended, and the trained
        # Solvers must stay readable until the next one really begins.
        self._updates = 0
        none_yet = torch.zeros(
            self._copies, self.proposals.choices, dtype=torch.int64, device=self.device
        )
        return self._state(self._origin_return, self._origin_probes, none_yet)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self._updates == 0 and not self._replaying:
            self.solvers.restore(self._origin)
            self._return = self._origin_return
            self._episode += 1
            self._taken = []
        reward = torch.zeros_like(self._origin_return)
        choices = []
        for update in range(self.updates_per_step):
            last = update == self.updates_per_step - 1
            taken = self._update(tensordict["action"], measure=last)
            reward += taken["reward"]
            choices.append(taken["choices"])
        proposed = _count(torch.cat(choices, -1), self.proposals.choices).to(self.device)
        state = self._state(self._return, taken["probes"], proposed)
        return state.set("reward", reward.unsqueeze(-1))

    def _update(self, action: Tensor, *, measure: bool) -> dict[str, Tensor]:
        """What comes of an update: ``reward`` [K], ``choices`` [K, P], measured also ``probes``."""
        if self._replaying:
            taken = self._remember(action)
        else:
            if self._updates:
                self._pause()
            taken = self._train(action, measure=measure)
            self._taken.append(taken)
        self._on_step()
        return taken

    def _remember(self, action: Tensor) -> dict[str, Tensor]:
        taken = self._taken[self._updates]
        if not torch.equal(taken["action"], action):
            raise ReplayError(f"another action for update {self._updates} of the episode")
        self._return = taken["return"]
        self._updates += 1
        self._replaying = self._updates < len(self._taken)
        return taken

    def _train(self, action: Tensor, *, measure: bool) -> dict[str, Tensor]:
        streams = self._copy_streams()
        problems = self.solvers.env.batch_size[1:].numel()
        levels, choices = self.proposals.levels(action, problems, streams)
        self.solvers.env.set_levels(levels)
        actions = [stream.generator("actions", device=self.device) for stream in streams]
        # A collector steps its environment without gradients; this one learns inside.
        place = f"update {self._updates} of the episode of the Solver's copies"
        with torch.enable_grad(), located(place):
            update = self.solvers.update(actions)
            self.solvers.check()
        self.last_training = (levels, update)
        self._updates += 1
        before = self._return
        if measure:
            self._return = self._validation_return()
        step = TrainingStep(levels, update.rollout, self.solvers.agent, before, self._return)
        taken = {
            "action": action,
            "choices": choices,
            "reward": self._reward(step),
            "return": self._return,
        }
        if measure:
            taken["probes"] = self.view.see(self.solvers.agent).clone()
        return taken

    def _set_seed(self, seed: int | None) -> None:
        self.streams = Streams(seed or 0)

    def _state(self, validation_return: Tensor, probes: Tensor, proposed: Tensor) -> TensorDict:
        progress = self._updates / self.episode_length
        state = self.view.observation(validation_return, probes, progress)
        ended = torch.full(
            (self._copies, 1),
            self._updates == self.episode_length,
            dtype=torch.bool,
            device=self.device,
        )
        return state.update({"proposed": proposed, "terminated": ended, "done": ended.clone()})

    def _validation_return(self) -> Tensor:
        place = (self._episode, self._updates)
        return self.view.validation_return(self.solvers.agent, *place)

    def _copy_streams(self) -> list[Streams]:
        return [
            self.streams.within(
                self._episode, self._updates, 0 if self.common_random_numbers else copy
            )
            for copy in range(self._copies)
        ]

    def _make_specs(self) -> None:
        def like(entry: Tensor) -> Unbounded:
            return Unbounded(entry.shape, dtype=entry.dtype, device=self.device)

        flags = ("terminated", "done")
        state = self._reset()
        observed = state.exclude(*flags)
        self.observation_spec = Composite(
            {str(key): like(entry) for key, entry in observed.items()}, shape=self.batch_size
        )
        problems = self.solvers.env.batch_size[1:].numel()
        self.action_spec = self.proposals.action_spec(self._copies, problems, self.device)
        self.reward_spec = like(state["validation_return"])
        flag = Categorical(2, shape=(self._copies, 1), dtype=torch.bool, device=self.device)
        self.done_spec = Composite({key: flag.clone() for key in flags}, shape=self.batch_size)


def _count(choices: Tensor, size: int) -> Tensor:
    """How often each of ``size`` choices occurs along the last dimension, int64 [K, size]."""
    counts = choices.new_zeros(choices.shape[0], size)
    return counts.scatter_add_(1, choices, torch.ones_like(choices))

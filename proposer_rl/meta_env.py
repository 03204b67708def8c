"""The meta-environment: one step is one PPO update of K Solvers on proposed levels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from proposer_rl.models import ActorCritic
from proposer_rl.ppo import PPO
from proposer_rl.rewards import Reward, TrainingStep
from proposer_rl.streams import Streams

Levels = Any  # a tensordict or tensorclass, of which nothing but the batch size is known here

# From choices, int64 [K, P], to levels [K, P]; copy k draws from the k-th generator.
Generate = Callable[[Tensor, list[torch.Generator]], Levels]

# Draws that many levels from a distribution.
SampleLevels = Callable[[int, torch.Generator], Levels]

# Mean "return" of K Solvers on each of the levels [E], as a tensordict [K, E]. An exact evaluator
# has no use for the generator.
Evaluate = Callable[[ActorCritic, Levels, torch.Generator], TensorDictBase]

# What is seen of K Solvers on levels [C]: float [K, C, ...].
Probe = Callable[[ActorCritic, Levels], Tensor]


class SolverTrainingEnv(EnvBase):
    """Training K Solvers as a batch of K episodes (section 5 of the paper).

    An action chooses the P levels of an update; the step generates them, trains each Solver on its
    own, and observes it through its answers on probe levels. An episode is ``episode_length``
    updates of Solvers that all start as the one given to :meth:`fork`. Nothing here knows what a
    level is.

    Observations: ``probes`` float [K, C, ...] and ``validation_return`` float [K, 1], the mean
    return on the validation levels. Actions: ``action`` int64 [K, P] in ``0..choices-1``. Episodes
    end by ``terminated`` after ``episode_length`` steps.

    Args:
        solvers: K Solvers and their environment, batch [K, P], with a method ``set_levels``.
        generate: makes the levels of an action.
        target: draws validation and probe levels.
        evaluate: the Solvers' performance on the validation levels.
        probe: what the Proposer sees of the Solvers.
        reward: what a step is worth.
        choices: categories N of each of the P parts of an action.
        episode_length: updates L of an episode.
        validation_levels: size E of the validation batch.
        probe_levels: number of probes C.
        on_step: called after every step, e.g. by a progress bar.

    Raises:
        ValueError: if the Solvers are no population, or a size is out of range.
    """

    def __init__(
        self,
        solvers: PPO,
        *,
        generate: Generate,
        target: SampleLevels,
        evaluate: Evaluate,
        probe: Probe,
        reward: Reward,
        choices: int,
        episode_length: int = 50,
        validation_levels: int = 75,
        probe_levels: int = 16,
        on_step: Callable[[], None] | None = None,
    ) -> None:
        if solvers.agent.copies is None:
            raise ValueError("the Solvers must be a population: their agent has no copies")
        if min(episode_length, validation_levels, choices) < 1 or probe_levels < 0:
            raise ValueError(
                "episode_length, validation_levels and choices must be at least 1, probe_levels "
                f"at least 0; got {episode_length}, {validation_levels}, {choices}, {probe_levels}"
            )
        self._copies = solvers.agent.copies
        super().__init__(device=solvers.env.device, batch_size=[self._copies])
        self.solvers = solvers
        self.episode_length = episode_length
        self.validation_levels = validation_levels
        self.probe_levels = probe_levels
        self.generate = generate
        self._target = target
        self._evaluate = evaluate
        self._probe = probe
        self._reward = reward
        self._on_step = on_step or (lambda: None)
        self.fork(solvers.snapshot()[0], Streams(0))
        self._make_specs(choices)

    def fork(self, solver: TensorDictBase, streams: Streams) -> None:
        """Start the next episodes from copies of one Solver, on new validation and probe levels.

        Args:
            solver: a snapshot of one Solver, batch [] (weights and Adam's state).
            streams: where the randomness of the levels and of the Solvers' actions comes from.
        """
        self.draw_levels(streams)
        self._origin = solver.expand(self._copies)
        self.solvers.restore(self._origin)
        self._episode = -1
        self._steps_done = 0
        self._origin_return = self._validation_return()
        self._origin_probes = self.see(self.solvers.agent)

    def draw_levels(self, streams: Streams) -> None:
        """Draw the validation and probe levels of an episode; :meth:`fork` does it too."""
        self.streams = streams
        self.validation = self._draw(self.validation_levels, "validation")
        self.probes = self._draw(self.probe_levels, "probes")

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        # Only marks the start: a collector resets as soon as an episode has ended, and the trained
        # Solvers must stay readable until the next one really begins.
        self._steps_done = 0
        return self._observe(self._origin_return, self._origin_probes)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self._steps_done == 0:
            self.solvers.restore(self._origin)
            self._return = self._origin_return
            self._episode += 1
        # Levels come from the host, in whatever time the device needs for its last update.
        levels = self.generate(tensordict["action"], self._generators("levels", "cpu"))
        self.solvers.env.set_levels(levels)
        # A collector steps its environment without gradients; this one learns inside.
        with torch.enable_grad():
            update = self.solvers.update(self._generators("actions", self.device))
        self.last_training = (levels, update)
        self._steps_done += 1
        before, self._return = self._return, self._validation_return()
        step = TrainingStep(levels, update.rollout, self.solvers.agent, before, self._return)
        reward = self._reward(step)
        self._on_step()
        after = self._observe(self._return, self.see(self.solvers.agent))
        ended = self._steps_done == self.episode_length
        for key in ("terminated", "done"):
            after[key].fill_(ended)
        return after.set("reward", reward.unsqueeze(-1))

    def _set_seed(self, seed: int | None) -> None:
        self.streams = Streams(seed or 0)

    def _observe(self, validation_return: Tensor, probes: Tensor) -> TensorDict:
        flag = torch.zeros(self._copies, 1, dtype=torch.bool, device=self.device)
        return TensorDict(
            {
                "probes": probes,
                "validation_return": validation_return.unsqueeze(-1),
                "terminated": flag,
                "done": flag.clone(),
            },
            self.batch_size,
            device=self.device,
        )

    @torch.no_grad()
    def _validation_return(self) -> Tensor:
        place = (self._episode, self._steps_done)
        generator = self.streams.generator("evaluation", *place, device=self.device)
        result = self._evaluate(self.solvers.agent, self.validation, generator)
        return result["return"].mean(1)  # [K]

    @torch.no_grad()
    def see(self, solver: ActorCritic) -> Tensor:
        """What the probe levels show of Solvers, float [K, C, ...]."""
        return self._probe(solver, self.probes)

    def _draw(self, count: int, purpose: str) -> Any:
        return self._target(count, self.streams.generator(purpose))

    def _generators(self, purpose: str, device: torch.device | str) -> list[torch.Generator]:
        step = self._steps_done
        return [
            self.streams.generator(purpose, self._episode, step, copy, device=device)
            for copy in range(self._copies)
        ]

    def _make_specs(self, choices: int) -> None:
        def unbounded(like: Tensor) -> Unbounded:
            return Unbounded(like.shape, dtype=like.dtype, device=self.device)

        problems = self.solvers.env.batch_size[1:]
        self.observation_spec = Composite(
            probes=unbounded(self._origin_probes),
            validation_return=unbounded(self._origin_return.unsqueeze(-1)),
            shape=self.batch_size,
        )
        self.action_spec = Categorical(
            choices, shape=(self._copies, *problems), dtype=torch.int64, device=self.device
        )
        self.reward_spec = unbounded(self._origin_return.unsqueeze(-1))
        flag = Categorical(2, shape=(self._copies, 1), dtype=torch.bool, device=self.device)
        self.done_spec = Composite(terminated=flag, done=flag.clone(), shape=self.batch_size)

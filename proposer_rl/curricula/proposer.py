"""The paper's Proposer as a curriculum, and the trainer that teaches it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula.bins import along_axes
from proposer_rl.curricula.contract import LearnedCurriculum
from proposer_rl.curricula.student import Student
from proposer_rl.learning import PPO, agent_weights, load_agent, located
from proposer_rl.meta.actions import Actions
from proposer_rl.meta.env import SolverTrainingEnv, SolverView
from proposer_rl.meta.replicas import Replicas
from proposer_rl.models import ActorCritic, draw_at
from proposer_rl.streams import Streams
from proposer_rl.task import Levels


class ProposerCurriculum(LearnedCurriculum):
    """Lets an agent, the Proposer, choose the levels; it learns from replicas of the student.

    Before each cycle the trainer runs one episode of the meta-environment with K replicas of the
    student, and the Proposer's PPO learns from it. Without a trainer the Proposer is frozen. During
    the cycle the student itself trains on the Proposer's proposals.

    Args:
        agent: the Proposer.
        view: how it sees the student, by levels that are new in every cycle.
        actions: turns its actions into levels.
        meta_episode_length: number L of updates in an episode of its training, by which it knows
            its progress in a cycle.
        action_repeat: number of batches for which an action holds.
        own_action: the action for the student itself: a ``"sample"`` of the policy, or its
            ``"mode"``, without exploration.
        trainer: trains the Proposer; None for a frozen one.
    """

    state = ("_proposed", "_action")

    def __init__(
        self,
        agent: ActorCritic,
        view: SolverView,
        actions: Actions,
        *,
        meta_episode_length: int,
        action_repeat: int,
        own_action: Literal["sample", "mode"],
        trainer: ProposerTrainer | None = None,
    ) -> None:
        self.agent, self.view, self.actions, self.trainer = agent, view, actions, trainer
        self.meta_episode_length, self.action_repeat = meta_episode_length, action_repeat
        self.own_action = own_action
        self.trains_replicas = trainer is not None
        # The first two to see the student, a snapshot to make replicas of it.
        self.needs = ("performance", "probe", *["snapshot"] * self.trains_replicas)
        self._proposed = 0  # batches of this cycle
        self._action: Tensor | None = None

    def improve(self, student: Student, rng: Streams) -> dict[str, Any]:
        """Draws the levels on which the Proposer sees the student, and trains the Proposer."""
        self._proposed = 0
        if self.trainer is not None:
            return self.trainer.train(student, rng)
        self.view.draw_levels(rng)
        return {}

    @torch.no_grad()
    def propose(self, student: Student, count: int, rng: Streams) -> Levels:
        """Draws levels [n] from the Proposer's policy, given its view of the student."""
        if self._action is None:  # the first batch can come within a cycle
            self._proposed = 0
        if self._action is None or self._proposed % self.action_repeat == 0:
            self._action = self._act(student, rng)
        self._proposed += 1
        levels, _ = self.actions.levels(self._action, count, [rng])
        return levels[0]

    def learnt(self) -> dict[str, Any]:
        """Returns the Proposer without its optimiser; nothing if the Proposer is frozen."""
        return {} if self.trainer is None else learnt_proposer(self.agent)

    def state_dict(self) -> dict[str, Any]:
        """Adds the agent and the address of the cycle's random streams."""
        agent = (
            agent_weights(self.agent) if self.trainer is None else self.trainer.learner.snapshot()
        )
        return super().state_dict() | {
            "streams": self.view.streams.address,
            "proposer": agent.to_dict(),
            "observed": self.agent.in_keys,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned, also in the middle of a cycle."""
        super().load_state_dict(state)
        self.view.draw_levels(Streams(*state["streams"]))
        agent = TensorDict(state["proposer"], batch_size=[])
        if self.trainer is None:
            load_agent(self.agent, agent)
        else:
            self.trainer.learner.restore(agent)

    def close(self) -> None:
        """Ends the processes in which replicas are trained."""
        if self.trainer is not None:
            self.trainer.replicas.close()

    def _act(self, student: Student, rng: Streams) -> Tensor:
        # If a cycle is longer than a training episode, progress starts over.
        progress = self._proposed % self.meta_episode_length / self.meta_episode_length
        # -1: before all episodes of the replicas, whose numbers begin at 0.
        draws = self.view.streams.generator("evaluation", -1, self._proposed)
        performance = student.performance(self.view.validation, draws).unsqueeze(0)
        probes = student.probe(self.view.probes).unsqueeze(0)
        state = self.view.observation(performance, probes, progress)
        distribution = self.agent.distribution(self.agent(state))
        if self.own_action == "mode":
            return distribution.mode
        generator = rng.generator("proposals")
        shape = (1, *distribution.batch_shape[1:], *distribution.event_shape)
        return draw_at(
            distribution, torch.rand(shape, generator=generator).to(self.view.task.device)
        )


class ProposerTrainer:
    """Trains a Proposer by the effect of its proposals on K replicas of the student.

    Args:
        learner: PPO of the Proposer, whose environment is a :class:`SolverTrainingEnv` and whose
            horizon is the number of steps of that environment's episodes.
        replicas: trains the replicas; None for the learner's own environment, in this process.

    Raises:
        ValueError: for a horizon other than the episode's.
    """

    def __init__(self, learner: PPO, replicas: Replicas | None = None) -> None:
        env: SolverTrainingEnv = learner.env
        if learner.settings.horizon != env.steps:
            raise ValueError(
                f"the Proposer's horizon {learner.settings.horizon} must be the "
                f"meta-environment's number of steps, {env.steps}"
            )
        self.learner, self.env = learner, env
        self.replicas = replicas or Replicas(learner)

    def curriculum(self, own_action: Literal["sample", "mode"]) -> ProposerCurriculum:
        """Returns the curriculum of this Proposer, which goes on learning."""
        env = self.env
        return ProposerCurriculum(
            self.learner.agent,
            env.view,
            env.actions,
            meta_episode_length=env.meta_episode_length,
            action_repeat=env.action_repeat,
            own_action=own_action,
            trainer=self,
        )

    def train(self, student: Student, rng: Streams) -> dict[str, Any]:
        """Trains K replicas of the student for an episode, and the Proposer on their rewards."""
        env = self.env
        rollout = self.replicas.roll_out(student.snapshot(), rng)
        with located("the Proposer"):
            training = self.learner.optimise(rollout)
            self.learner.check()
        rewards = rollout["next", "reward"].sum((-2, -1))  # [K]
        replicas = len(rewards)
        student.spend(
            frames=replicas * env.batch_of_levels * env.solvers.horizon * env.meta_episode_length,
            # Every replica after each of its actions, and once at the start.
            evaluations=replicas * (env.steps + 1) * env.view.validation_levels,
        )
        return self._metrics(rollout, rewards, training)

    def _metrics(
        self, rollout: TensorDictBase, rewards: Tensor, training: TensorDict
    ) -> dict[str, Any]:
        proposed = rollout["next", "proposed"].sum((0, 1))  # [N]
        gains = {
            f"{name}_gain": (rollout["next", name][:, -1, 0] - rollout[name][:, 0, 0]).tolist()
            for name in ("return", "log_success")
            if name in rollout.keys()
        }
        return {
            **gains,
            "total_reward": rewards.tolist(),
            "reward_sd": float(rewards.std(correction=0)),
            **{key: float(value) for key, value in training.items()},
            "histogram": along_axes(proposed, self.env.actions.space),
        }


def learnt_proposer(agent: ActorCritic) -> dict[str, Any]:
    """Returns a Proposer's weights and the names of what it observes, for a state."""
    return {"proposer": agent_weights(agent).to_dict(), "observed": agent.in_keys}

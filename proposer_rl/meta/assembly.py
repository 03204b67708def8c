"""The parts of a run, and the Proposer's network, actions and environment from its settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field
from typing import Annotated, Any, Literal, NamedTuple

from annotated_types import Ge, Gt
from torch import nn
from torch.distributions import Distribution

from proposer_rl.learning import LearningSettings
from proposer_rl.meta.actions import Actions, Mixture, ProblemChoices
from proposer_rl.meta.env import SolverTrainingEnv, SolverView
from proposer_rl.meta.rewards import Reward
from proposer_rl.meta.workers import WorkerSettings
from proposer_rl.models import ActorCritic, categorical, joint_categorical, normal, proposer
from proposer_rl.settings import BY_KIND, ArgumentError, settings
from proposer_rl.streams import Streams
from proposer_rl.task import Task


@settings
class MixtureSettings:
    """Settings of actions that are mixtures of bins for a whole batch.

    Attributes:
        spread: standard deviation of the first policy.
    """

    kind: Literal["mixture"] = "mixture"
    spread: Annotated[float, Gt(0)] = 1.5


@settings
class ProblemSettings:
    """Settings of actions that name the bin of every level (the paper's Proposer).

    Attributes:
        ratio: PPO's ratio over the P draws together, or for each draw.
        bands: frequencies of the problem index's Fourier encoding.
    """

    kind: Literal["problems"] = "problems"
    ratio: Literal["joint", "per_problem"] = "per_problem"
    bands: Annotated[int, Ge(1)] = 16


@settings
class ProposerSettings:
    """Settings of a Proposer and its meta-environment; the defaults learn best, unlike the paper's.

    Attributes:
        rollouts: number K of replicas of the Solver that train side by side.
        meta_episode_length: number L of updates in a meta-episode.
        action_repeat: number of updates for which an action holds; divides L.
        validation_levels: number E of levels on which the gain is measured.
        probe_levels: number C of target levels on which the Proposer sees the Solver's outputs.
        observes: numbers that the Proposer observes besides the probes.
        action: meaning of an action.
        own_action: action for the Solver itself: a sample of the policy or its mode.
        advantage: relative to the mean of the other replicas, or by a critic.
        context, hidden: widths of the network.
        ppo: PPO's numbers; the horizon is the number of actions in a meta-episode.
    """

    rollouts: Annotated[int, Ge(1)] = 16
    meta_episode_length: Annotated[int, Ge(1)] = 50
    action_repeat: Annotated[int, Ge(1)] = 50
    validation_levels: Annotated[int, Ge(1)] = 512
    probe_levels: Annotated[int, Ge(0)] = 16
    observes: list[Literal["return", "log_success", "progress"]] = field(
        default_factory=lambda: ["log_success", "progress"]
    )
    action: Annotated[MixtureSettings | ProblemSettings, BY_KIND] = MixtureSettings()
    own_action: Literal["sample", "mode"] = "mode"
    advantage: Literal["leave_one_out", "gae"] = "leave_one_out"
    context: Annotated[int, Ge(1)] = 128
    hidden: Annotated[int, Ge(1)] = 128
    ppo: LearningSettings = LearningSettings(updates=3, epochs=16, gamma=1.0)


Workers = tuple[WorkerSettings, Callable[[str], Task]]
"""Other processes in which replicas of the Solver train, and a function that makes the task there.

The function takes a device, and can be pickled.
"""


class Components(NamedTuple):
    """The parts of a run that curricula are made of.

    Attributes:
        task: a :class:`~proposer_rl.Task`; in a :class:`~proposer_rl.Teacher` it may be only a
            space of levels.
        proposer: the Proposer's settings.
        seed: of the Solver, and of a Proposer's weights.
        on_update: called after every update of replicas in this process, with the number of updates
            in the episode so far.
        workers: other processes for the replicas; None for this process.
    """

    task: Any
    proposer: ProposerSettings
    seed: int
    on_update: Callable[[int], None] | None = None
    workers: Workers | None = None

    def optional(self, name: str) -> Any:
        """Returns an attribute of the task, such as ``edit``, or None if it has none."""
        try:
            return getattr(self.task, name)
        except (AttributeError, ArgumentError):  # the latter of a space without a target
            return None


def meta_env(
    task: Task,
    config: ProposerSettings,
    streams: Streams,
    reward: Reward,
    share: range,
    on_update: Callable[[int], None] | None = None,
    kind: type[SolverTrainingEnv] = SolverTrainingEnv,
) -> SolverTrainingEnv:
    """Makes the environment in which some of a Solver's K replicas train.

    Args:
        task: makes the replicas and their levels.
        config: the Proposer's settings.
        streams: of the replicas' first weights.
        reward: of an update.
        share: numbers of the replicas that train here.
        on_update: called after every update; see :class:`SolverTrainingEnv`.
        kind: class of the environment.
    """
    return kind(
        task.learner([streams] * len(share)),
        view=solver_view(task, config),
        actions=proposer_actions(task, config),
        reward=reward,
        meta_episode_length=config.meta_episode_length,
        action_repeat=config.action_repeat,
        first_replica=share.start,
        on_update=on_update,
    )


def solver_view(task: Task, config: ProposerSettings) -> SolverView:
    """Makes the Proposer's view of a Solver from its settings."""
    return SolverView(
        task, validation_levels=config.validation_levels, probe_levels=config.probe_levels
    )


def proposer_actions(task: Task, config: ProposerSettings) -> Actions:
    """Makes the meaning of the Proposer's actions from its settings."""
    kinds = {MixtureSettings: Mixture, ProblemSettings: ProblemChoices}
    return kinds[type(config.action)](task.space)


def proposer_agent(task: Task, config: ProposerSettings) -> ActorCritic:
    """Makes the Proposer's policy and critic, with weights from torch's default generator."""
    action, hidden = config.action, config.hidden
    width = config.context + len(config.observes)
    head: nn.Module
    distribution: Callable[..., Distribution]
    if isinstance(action, MixtureSettings):
        directions = task.space.coordinates.shape[1]
        head = proposer.MixtureHead(width, directions, hidden=hidden, spread=action.spread)
        distribution = normal
    else:
        size = task.batch_size, task.space.size
        head = proposer.ProblemHead(width, *size, hidden=hidden, bands=action.bands)
        distribution = joint_categorical if action.ratio == "joint" else categorical
    network = proposer.ProposerNetwork(
        head,
        task.probe_encoder(config.context),
        context=config.context,
        numbers=len(config.observes),
        hidden=hidden,
    ).to(task.device)
    return proposer.proposer_actor_critic(network, distribution, ["probes", *config.observes])

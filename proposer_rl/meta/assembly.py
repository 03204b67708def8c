"""A Proposer's network, its actions and its environment, put together from its settings."""

from __future__ import annotations

from collections.abc import Callable

from torch import nn
from torch.distributions import Distribution

from proposer_rl.meta import rewards
from proposer_rl.meta.actions import Actions, Mixture, ProblemChoices
from proposer_rl.meta.env import SolverTrainingEnv
from proposer_rl.meta.settings import MixtureSettings, ProblemSettings, ProposerSettings
from proposer_rl.meta.view import SolverView
from proposer_rl.models import (
    ActorCritic,
    MixtureHead,
    ProblemHead,
    ProposerNetwork,
    categorical,
    joint_categorical,
    normal,
    proposer_actor_critic,
)
from proposer_rl.streams import Streams
from proposer_rl.task import Task


def meta_env(
    task: Task,
    config: ProposerSettings,
    streams: Streams,
    reward: rewards.Reward,
    share: range,
    on_update: Callable[[int], None] | None = None,
    kind: type[SolverTrainingEnv] = SolverTrainingEnv,
) -> SolverTrainingEnv:
    """The environment in which those of a Solver's K replicas train whose numbers are ``share``."""
    return kind(
        task.learner([streams] * len(share)),
        view=solver_view(task, config),
        actions=proposer_actions(task, config),
        reward=reward,
        meta_episode_length=config.meta_episode_length,
        action_repeat=config.action_repeat,
        first_copy=share.start,
        on_update=on_update,
    )


def solver_view(task: Task, config: ProposerSettings) -> SolverView:
    """What a Proposer sees of a Solver."""
    return SolverView(
        task, validation_levels=config.validation_levels, probe_levels=config.probe_levels
    )


def proposer_actions(task: Task, config: ProposerSettings) -> Actions:
    """What its actions mean."""
    kinds = {MixtureSettings: Mixture, ProblemSettings: ProblemChoices}
    return kinds[type(config.action)](task.space)


def proposer_agent(task: Task, config: ProposerSettings) -> ActorCritic:
    """The Proposer, with weights from torch's default generator."""
    action, hidden = config.action, config.hidden
    width = config.context + len(config.observes)
    head: nn.Module
    distribution: Callable[..., Distribution]
    if isinstance(action, MixtureSettings):
        directions = task.space.coordinates.shape[1]
        head = MixtureHead(width, directions, hidden=hidden, spread=action.spread)
        distribution = normal
    else:
        size = task.batch_size, task.space.size
        head = ProblemHead(width, *size, hidden=hidden, bands=action.bands)
        distribution = joint_categorical if action.ratio == "joint" else categorical
    network = ProposerNetwork(
        head,
        task.probe_encoder(config.context),
        context=config.context,
        numbers=len(config.observes),
        hidden=hidden,
    ).to(task.device)
    return proposer_actor_critic(network, distribution, ["probes", *config.observes])

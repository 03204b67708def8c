"""Methods: how a curriculum is put together from the task's parts. A method's config names one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Annotated, Literal, NamedTuple

from annotated_types import Ge, Len

from proposer_rl.curricula import (
    Curriculum,
    ProposerCurriculum,
    SamplingCurriculum,
    ScheduleCurriculum,
)
from proposer_rl.meta_env import SolverTrainingEnv
from proposer_rl.models import ProposerNetwork, proposer_actor_critic
from proposer_rl.ppo import PPO, PPOSettings
from proposer_rl.rewards import Reward
from proposer_rl.settings import settings
from proposer_rl.streams import Streams
from proposer_rl.task import MazeTask


@settings
class ProposerSettings:
    """The Proposer and its meta-environment.

    Attributes:
        rollouts: copies K of the Solver that are trained side by side.
        lookahead: updates L of a meta-episode.
        validation_levels: size E of the batch that the gain is measured on.
        probe_levels: number C of target levels through which the Solver is seen.
        ratio: PPO's ratio over the P draws together, or for each draw.
        advance: what becomes of the Solver after a meta-episode.
        context, hidden, channels, bands: sizes of the network.
        ppo: PPO's numbers; its horizon is ``lookahead``.
    """

    rollouts: Annotated[int, Ge(1)] = 16
    lookahead: Annotated[int, Ge(1)] = 50
    validation_levels: Annotated[int, Ge(1)] = 75
    probe_levels: Annotated[int, Ge(0)] = 16
    ratio: Literal["joint", "per_problem"] = "per_problem"
    advance: Literal["train", "best", "random"] = "train"
    context: Annotated[int, Ge(1)] = 128
    hidden: Annotated[int, Ge(1)] = 128
    channels: Annotated[list[Annotated[int, Ge(1)]], Len(1)]
    bands: Annotated[int, Ge(1)] = 16
    ppo: PPOSettings


class Parts(NamedTuple):
    """What a method's factory gets: the task, the Proposer's settings, the seed, a step counter."""

    task: MazeTask
    proposer: ProposerSettings
    seed: int
    on_step: Callable[[], None] | None = None


def target(parts: Parts) -> Curriculum:
    """Train on the target distribution itself (the paper's baseline)."""
    return SamplingCurriculum(parts.task.sample_target)


def domain_randomization(parts: Parts) -> Curriculum:
    """Train on levels drawn evenly from the Proposer's space."""
    return SamplingCurriculum(parts.task.sample_space)


def schedule(parts: Parts, distributions: Sequence[str], until: Sequence[int]) -> Curriculum:
    """Train on named distributions one after another: a curriculum by hand.

    Args:
        parts: the task.
        distributions: names, in order.
        until: updates after which each but the last ends.

    Raises:
        ValueError: for an unknown name, or as :class:`ScheduleCurriculum`.
    """
    known = parts.task.distributions
    unknown = [name for name in distributions if name not in known]
    if unknown:
        raise ValueError(f"distributions must be among {sorted(known)}, got {unknown}")
    stages = [SamplingCurriculum(known[name].sample) for name in distributions]
    return ScheduleCurriculum(stages, until)


def proposer(parts: Parts, reward: Reward) -> Curriculum:
    """Train on the proposals of an agent that is rewarded for each of the Solver's updates."""
    task, chosen = parts.task, parts.proposer
    streams = Streams(parts.seed, "proposer")
    env = SolverTrainingEnv(
        task.solvers([streams] * chosen.rollouts),
        generate=task.generate,
        target=task.sample_target,
        evaluate=task.evaluate,
        probe=task.probe,
        reward=reward,
        choices=task.space.size,
        episode_length=chosen.lookahead,
        validation_levels=chosen.validation_levels,
        probe_levels=chosen.probe_levels,
        on_step=parts.on_step,
    )
    with streams.as_default("weights"):
        network = ProposerNetwork(
            env.observation_spec["probes"].shape[2],
            problems=task.solver.problems,
            choices=task.space.size,
            context=chosen.context,
            hidden=chosen.hidden,
            channels=chosen.channels,
            bands=chosen.bands,
        ).to(task.device)
    agent = proposer_actor_critic(network, chosen.ratio)
    ppo = PPO(env, agent, replace(chosen.ppo, horizon=chosen.lookahead))
    return ProposerCurriculum(ppo, advance=chosen.advance, histogram=task.space.histogram)

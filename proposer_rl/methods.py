"""Methods: how a curriculum is put together from the task's parts. A method's config names one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from annotated_types import Ge, Gt, Len
from tensordict import TensorDict
from torch import nn
from torch.distributions import Distribution

from proposer_rl.curricula import (
    Curriculum,
    FrozenProposer,
    ProposerCurriculum,
    SamplingCurriculum,
    ScheduleCurriculum,
    load_agent,
)
from proposer_rl.learning.advantages import CopiesBaseline
from proposer_rl.learning.losses import MakeLoss
from proposer_rl.learning.ppo import PPO, PPOSettings
from proposer_rl.mazes.task import MazeTask
from proposer_rl.meta.actions import Mixture, ProblemChoices, Proposals
from proposer_rl.meta.env import SolverTrainingEnv
from proposer_rl.meta.rewards import Reward
from proposer_rl.meta.view import SolverView, episode_return, log_success
from proposer_rl.meta.workers import CopiesInWorkers, WorkerSettings
from proposer_rl.models import (
    ActorCritic,
    MapEncoder,
    MixtureHead,
    ProblemHead,
    ProposerNetwork,
    categorical,
    joint_categorical,
    normal,
    proposer_actor_critic,
)
from proposer_rl.runs.checkpoint import CheckpointError, State, load_checkpoint, load_latest
from proposer_rl.settings import settings
from proposer_rl.streams import Streams


@settings
class ProposerSettings:
    """The Proposer and its meta-environment.

    Attributes:
        rollouts: copies K of the Solver that are trained side by side.
        lookahead: updates L of a meta-episode.
        updates_per_step: updates for which an action holds; divides ``lookahead``.
        validation_levels: size E of the batch that the gain is measured on.
        probe_levels: number C of target levels through which the Solver is seen.
        observes: what is seen beside the probes.
        number_bands: frequencies at which that is told to the network; 0: as it is.
        common_random_numbers: whether the copies differ by their actions alone.
        measure: what the gain is counted in, on the validation levels.
        proposals: an action's meaning: the choice of every problem, or a mixture of choices.
        ratio: of ``problems``: PPO's ratio over the P draws together, or for each draw.
        directions: of a ``mixture``: what an action's numbers stand for.
        spread: of a ``mixture``: standard deviation of the first policy.
        own_action: what the Solver itself trains on: a sample of the policy or its mode.
        advance: what becomes of the Solver after a meta-episode.
        advantage: by a critic (``gae``), or against the mean of the other ``copies``.
        context, hidden, channels, bands: sizes of the network.
        ppo: PPO's numbers; its horizon is ``lookahead``.
    """

    rollouts: Annotated[int, Ge(1)] = 16
    lookahead: Annotated[int, Ge(1)] = 50
    updates_per_step: Annotated[int, Ge(1)] = 50
    validation_levels: Annotated[int, Ge(1)] = 512
    probe_levels: Annotated[int, Ge(0)] = 16
    observes: list[Literal["validation_return", "progress"]] = field(
        default_factory=lambda: ["validation_return", "progress"]
    )
    number_bands: Annotated[int, Ge(0)] = 0
    common_random_numbers: bool = False
    measure: Literal["return", "log_success"] = "log_success"
    proposals: Literal["problems", "mixture"] = "mixture"
    ratio: Literal["joint", "per_problem"] = "per_problem"
    directions: Literal["linear", "target", "quadratic", "all"] = "linear"
    spread: Annotated[float, Gt(0)] = 1.5
    own_action: Literal["sample", "mode"] = "mode"
    advance: Literal["train", "best", "random"] = "train"
    advantage: Literal["gae", "copies"] = "copies"
    context: Annotated[int, Ge(1)] = 128
    hidden: Annotated[int, Ge(1)] = 128
    channels: Annotated[list[Annotated[int, Ge(1)]], Len(1)]
    bands: Annotated[int, Ge(1)] = 16
    ppo: PPOSettings


class Parts(NamedTuple):
    """What a method's factory gets.

    Attributes:
        task: the mazes and the Solver.
        proposer: the Proposer's settings.
        seed: of its weights.
        on_step: called after every update of the copies, where they are trained in this process.
        workers: where else they are trained; None for this process.
    """

    task: MazeTask
    proposer: ProposerSettings
    seed: int
    on_step: Callable[[], None] | None = None
    workers: WorkerSettings | None = None


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


def proposer(parts: Parts, reward: Reward, loss: MakeLoss | None = None) -> Curriculum:
    """Train on the proposals of an agent that is rewarded for each of the Solver's updates.

    Args:
        parts: the task, and the Proposer's settings.
        reward: what an update is worth.
        loss: of the Proposer; None for PPO's. See :class:`~proposer_rl.learning.ppo.PPO`.

    Raises:
        TypeError: if the reward is no function.
    """
    if not callable(reward):
        raise TypeError(f"reward must be a function of a training step, got {reward!r}")
    task, chosen = parts.task, parts.proposer
    streams = Streams(parts.seed, "proposer")
    env = _meta_env(task, chosen, parts.seed, reward, on_step=parts.on_step)
    action = ACTIONS[chosen.proposals](task, chosen)
    with streams.as_default("weights"):
        agent = _agent(task, chosen, action)
    numbers = replace(chosen.ppo, horizon=env.steps)
    advantage = CopiesBaseline(numbers.gamma) if chosen.advantage == "copies" else None
    learner = PPO(env, agent, numbers, advantage=advantage, loss=loss)
    workers = parts.workers
    return ProposerCurriculum(
        learner,
        copies=None
        if workers is None
        else CopiesInWorkers(
            learner,
            partial(
                _worker_env, partial(task.recipe, cores=workers.cores), chosen, parts.seed, reward
            ),
            workers,
        ),
        own_action=chosen.own_action,
        advance=chosen.advance,
        table=lambda counts: counts.unflatten(0, task.space.shape),
    )


def _meta_env(
    task: MazeTask,
    chosen: ProposerSettings,
    seed: int,
    reward: Reward,
    *,
    share: range | None = None,
    kind: type[SolverTrainingEnv] = SolverTrainingEnv,
    on_step: Callable[[], None] | None = None,
) -> SolverTrainingEnv:
    return kind(
        task.solvers([Streams(seed, "proposer")] * chosen.rollouts, share),
        view=_view(task, chosen),
        proposals=ACTIONS[chosen.proposals](task, chosen).proposals,
        reward=reward,
        episode_length=chosen.lookahead,
        updates_per_step=chosen.updates_per_step,
        common_random_numbers=chosen.common_random_numbers,
        on_step=on_step,
    )


def _worker_env(
    make_task: Callable[..., MazeTask],
    chosen: ProposerSettings,
    seed: int,
    reward: Reward,
    *,
    share: range,
    device: str,
    kind: type[SolverTrainingEnv],
) -> SolverTrainingEnv:
    return _meta_env(make_task(device=device), chosen, seed, reward, share=share, kind=kind)


def frozen_proposer(parts: Parts, checkpoint: str | None) -> Curriculum:
    """Train on the proposals of a Proposer that has learnt in another run, and learns no more.

    Args:
        parts: the task, and the settings of the Proposer's network and actions, which must be those
            of that run.
        checkpoint: a checkpoint of that run, or its folder for the newest.

    Raises:
        ValueError: if nothing is named, or it holds no such Proposer.
        CheckpointError: if it cannot be read.
    """
    if not checkpoint:
        raise ValueError("checkpoint=: name a run's folder or a checkpoint that has a Proposer")
    task, chosen = parts.task, parts.proposer
    action = ACTIONS[chosen.proposals](task, chosen)
    agent = _agent(task, chosen, action)
    learnt = _curriculum_state(Path(checkpoint))
    try:
        load_agent(agent, TensorDict(learnt["proposer"]))
    except (KeyError, ValueError) as error:
        raise ValueError(
            f"checkpoint={checkpoint}: holds no Proposer with the network of these settings"
        ) from error
    return FrozenProposer(
        agent,
        _view(task, chosen),
        action.proposals,
        episode_length=chosen.lookahead,
        updates_per_step=chosen.updates_per_step,
        own_action=chosen.own_action,
    )


def _curriculum_state(path: Path) -> State:
    """The curriculum's part of a checkpoint, or of a run's newest one."""
    if path.is_dir():
        latest = load_latest(path / "checkpoints")
        if latest is None:
            raise CheckpointError(f"checkpoint={path}: the folder holds no checkpoints")
        return latest[1]["curriculum"]
    return load_checkpoint(path)[1]["curriculum"]


class _Action(NamedTuple):
    """What an action means, the head that makes it of a context, and its distribution."""

    proposals: Proposals
    head: Callable[[int], nn.Module]
    distribution: Callable[..., Distribution]


def _problems(task: MazeTask, chosen: ProposerSettings) -> _Action:
    size, problems = task.space.size, task.solver.problems
    return _Action(
        ProblemChoices(size, task.generate),
        lambda width: ProblemHead(width, problems, size, hidden=chosen.hidden, bands=chosen.bands),
        joint_categorical if chosen.ratio == "joint" else categorical,
    )


def _mixture(task: MazeTask, chosen: ProposerSettings) -> _Action:
    directions = task.directions(chosen.directions)
    return _Action(
        Mixture(directions, task.generate),
        lambda width: MixtureHead(
            width, directions.shape[0], hidden=chosen.hidden, spread=chosen.spread
        ),
        normal,
    )


MEASURES = {"return": episode_return, "log_success": log_success}
ACTIONS = {"problems": _problems, "mixture": _mixture}


def _view(task: MazeTask, chosen: ProposerSettings) -> SolverView:
    return SolverView(
        target=task.sample_target,
        evaluate=task.evaluate,
        probe=task.probe,
        measure=MEASURES[chosen.measure],
        validation_levels=chosen.validation_levels,
        probe_levels=chosen.probe_levels,
        device=task.device,
    )


def _agent(task: MazeTask, chosen: ProposerSettings, action: _Action) -> ActorCritic:
    numbers = len(chosen.observes)
    network = ProposerNetwork(
        action.head(chosen.context + numbers),
        MapEncoder(task.probe_channels, chosen.channels, chosen.context),
        context=chosen.context,
        numbers=numbers,
        hidden=chosen.hidden,
    ).to(task.device)
    return proposer_actor_critic(network, action.distribution, ["probes", *chosen.observes])

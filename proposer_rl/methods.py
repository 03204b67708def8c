"""Methods: how a curriculum is put together from the task's parts. A method's config names one.

Each is a factory of the :class:`Parts` and the config's numbers, which are mostly those of the
curriculum that it makes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from tensordict import TensorDict

from proposer_rl.curricula import (
    Curriculum,
    Filtered,
    FirstOrderCurriculum,
    FirstOrderProposer,
    LearningProgressCurriculum,
    MixtureCurriculum,
    PairedProposer,
    ProposerCurriculum,
    ProposerTrainer,
    ReplayCurriculum,
    ReplayRule,
    SampledFirstOrderCurriculum,
    SamplingCurriculum,
    Scorer,
    SelectionCurriculum,
    SomeBins,
    TaskStudent,
    TransportCurriculum,
)
from proposer_rl.curricula import Schedule as StagedCurriculum
from proposer_rl.curricula.buffer import Prioritization
from proposer_rl.curricula.scores import Source
from proposer_rl.learning import PPO, LeaveOneOutBaseline, MakeLoss, load_agent
from proposer_rl.meta import rewards
from proposer_rl.meta.assembly import (
    meta_env,
    proposer_actions,
    proposer_agent,
    solver_view,
    worker_env,
)
from proposer_rl.meta.workers import CopiesInWorkers, WorkerSettings
from proposer_rl.models import ActorCritic
from proposer_rl.runs.checkpoint import CheckpointError, State, load_checkpoint, load_latest
from proposer_rl.runs.folder import PROPOSER
from proposer_rl.settings import FilterSettings, PPOSettings, ProblemSettings, ProposerSettings
from proposer_rl.streams import Streams
from proposer_rl.task import LocatedTarget, Task


class Workers(NamedTuple):
    """Other processes in which copies are trained.

    Attributes:
        settings: how many there are, and where.
        make_task: makes the task in one of them, given its device; can be pickled.
        tell: called now and then with the number of updates that all copies have had of an episode.
    """

    settings: WorkerSettings
    make_task: Callable[[str], Task]
    tell: Callable[[int], None] = lambda done: None


class Parts(NamedTuple):
    """What a method's factory gets.

    Attributes:
        task: what is to be learnt.
        proposer: the Proposer's settings.
        seeds: of the Solvers that are trained side by side; the first is that of a Proposer's
            weights.
        on_update: called with the number of an episode's updates after every one of the copies that
            are trained in this process.
        workers: where else they are trained; None for this process.
    """

    task: Task
    proposer: ProposerSettings
    seeds: Sequence[int]
    on_update: Callable[[int], None] | None = None
    workers: Workers | None = None


def filtered(curriculum: Curriculum, chosen: FilterSettings | None) -> Curriculum:
    """A curriculum that draws more levels than are trained on, and keeps some by their scores.

    Args:
        curriculum: any.
        chosen: how; None to leave the curriculum as it is.

    Raises:
        ValueError: if a value is wrong, naming its key.
    """
    if chosen is None:
        return curriculum
    try:
        scorer = Scorer(chosen.score, chosen.source, chosen.rollouts)
        return Filtered(curriculum, scorer, times=chosen.times, temperature=chosen.temperature)
    except ValueError as error:
        raise ValueError(f"filter.{error}") from error


def target(parts: Parts) -> Curriculum:
    """Train on the target distribution itself (the paper's baseline)."""
    return SamplingCurriculum(parts.task.target)


def domain_randomization(parts: Parts) -> Curriculum:
    """Train on levels drawn uniformly from the Proposer's space."""
    return SamplingCurriculum(parts.task.space)


def schedule(parts: Parts, distributions: Sequence[str], until: Sequence[int]) -> Curriculum:
    """Train on named distributions one after another: a hand-designed curriculum.

    Args:
        parts: the task.
        distributions: names, in order.
        until: updates after which each but the last ends.

    Raises:
        ValueError: for an unknown name, or as :class:`~proposer_rl.curricula.Schedule`.
    """
    known = parts.task.distributions
    if isinstance(distributions, str) or any(name not in known for name in distributions):
        raise ValueError(
            f"distributions must be a list of some of {sorted(known)}, got {distributions}"
        )
    if not isinstance(until, Sequence) or any(type(end) is not int for end in until):
        raise ValueError(f"until must be a list of whole numbers, got {until!r}")
    return StagedCurriculum([SamplingCurriculum(known[name]) for name in distributions], until)


def proposer(
    parts: Parts,
    reward: rewards.Reward = rewards.log_success_gain,
    loss: MakeLoss | None = None,
    checkpoint: str | None = None,
) -> ProposerCurriculum:
    """Train on the proposals of an agent that is rewarded for each of the Solver's updates.

    Args:
        parts: the task, and the Proposer's settings.
        reward: of an update.
        loss: of the Proposer; None for PPO's. See :class:`~proposer_rl.learning.PPO`.
        checkpoint: of a Proposer that has learnt, which goes on learning; see
            :func:`frozen_proposer`. None to begin anew.

    Raises:
        CheckpointError: if the checkpoint cannot be read.
        TypeError: if the reward is no function.
        ValueError: for several seeds, or settings that do not go together.
    """
    if not callable(reward):
        raise TypeError(f"reward must be a function of a training step, got {reward!r}")
    _one_solver(parts)
    task, chosen = parts.task, parts.proposer
    if chosen.advantage == "leave_one_out" and chosen.rollouts < 2:
        raise ValueError(
            f"proposer.rollouts={chosen.rollouts} must be at least 2 where "
            "proposer.advantage=leave_one_out"
        )
    streams = Streams(parts.seeds[0], "proposer")
    env = meta_env(task, chosen, streams, reward, range(chosen.rollouts), parts.on_update)
    unknown = [name for name in chosen.observes if name not in env.observation_spec.keys()]
    if unknown:
        raise ValueError(
            f"proposer.observes={chosen.observes}: this task does not tell {', '.join(unknown)}; "
            "return and progress are available"
        )
    with streams.as_default("weights"):
        agent = proposer_agent(task, chosen)
    if checkpoint:
        _load(agent, checkpoint, chosen.observes)
    numbers = PPOSettings(horizon=env.steps, **asdict(chosen.ppo))
    advantage = LeaveOneOutBaseline(numbers.gamma) if chosen.advantage == "leave_one_out" else None
    learner = PPO(env, agent, numbers, advantage=advantage, loss=loss)
    copies = None
    if parts.workers is not None:
        settings, make_task, tell = parts.workers
        make_env = partial(worker_env, make_task, chosen, streams, reward)
        copies = CopiesInWorkers(learner, make_env, settings, tell)
    return ProposerTrainer(learner, copies, chosen.advance).curriculum(chosen.own_action)


def task_difficulty(parts: Parts, checkpoint: str | None = None) -> ProposerCurriculum:
    """Train on the proposals of an agent that is rewarded for the Solver's failures on them.

    The paper's ablation; no other reward can be put in its place.
    """
    return proposer(parts, rewards.task_difficulty, checkpoint=checkpoint)


def frozen_proposer(parts: Parts, checkpoint: str | None) -> ProposerCurriculum:
    """Train on the proposals of a Proposer that has learnt in another run, and learns no more.

    Args:
        parts: the task, and the settings of the Proposer's network and actions, which must be those
            of that run.
        checkpoint: a checkpoint of that run, its ``proposer.pt``, or its folder.

    Raises:
        ValueError: if nothing is named, it holds no such Proposer, or there are several seeds.
        CheckpointError: if it cannot be read.
    """
    _one_solver(parts)
    if not checkpoint:
        raise ValueError("checkpoint=: name a run's folder or a checkpoint that has a Proposer")
    task, chosen = parts.task, parts.proposer
    agent = proposer_agent(task, chosen)
    _load(agent, checkpoint, chosen.observes)
    return ProposerCurriculum(
        agent,
        solver_view(task, chosen),
        proposer_actions(task, chosen),
        meta_episode_length=chosen.meta_episode_length,
        action_repeat=chosen.action_repeat,
        own_action=chosen.own_action,
    )


def alp_gmm(parts: Parts, **numbers: Any) -> MixtureCurriculum:
    """Train on draws from Gaussians; see :class:`MixtureCurriculum` for the numbers."""
    return MixtureCurriculum(parts.task.space, **numbers)


def learning_progress(parts: Parts, **numbers: Any) -> LearningProgressCurriculum:
    """Train where success changes; see :class:`LearningProgressCurriculum` for the numbers."""
    return LearningProgressCurriculum(parts.task.space, **numbers)


def currot(parts: Parts, **numbers: Any) -> TransportCurriculum:
    """Train on the way to the target; see :class:`TransportCurriculum` for the numbers.

    Raises:
        TypeError: if the task does not say where its target lies.
    """
    if not isinstance(parts.task, LocatedTarget):
        raise TypeError(
            f"currot moves towards the target: {type(parts.task).__name__} must define "
            "target_shares, the target as shares of the space's bins"
        )
    return TransportCurriculum(parts.task.space, parts.task.target_shares, **numbers)


def first_order_gain(parts: Parts, **numbers: Any) -> FirstOrderCurriculum:
    """Train on aligned bins; see :class:`FirstOrderCurriculum` for the numbers."""
    return FirstOrderCurriculum(parts.task.space, parts.task.target, **numbers)


def first_order_sampled(parts: Parts, **numbers: Any) -> SampledFirstOrderCurriculum:
    """The same from episodes; see :class:`SampledFirstOrderCurriculum` for the numbers."""
    return SampledFirstOrderCurriculum(parts.task.space, parts.task.target, **numbers)


def replay(
    parts: Parts,
    score: str,
    source: Source,
    rollouts: int,
    prioritization: Prioritization,
    temperature: float,
    best: int | None,
    staleness: float,
    new_levels: Mapping[str, Sequence[float]] | None,
    **numbers: Any,
) -> ReplayCurriculum:
    """Train on levels that are kept by their scores.

    ``score``, ``source`` and ``rollouts`` are those of :class:`Scorer`, ``prioritization``,
    ``temperature``, ``best`` and ``staleness`` those of :class:`ReplayRule`. ``new_levels`` says
    what bins new levels come from, for some of the space's axes, by name, the values that count;
    None for the whole space. Further numbers: see :class:`ReplayCurriculum`.
    """
    rule = ReplayRule(
        prioritization=prioritization, temperature=temperature, best=best, staleness=staleness
    )
    space, edit = parts.task.space, getattr(parts.task, "edit", None)
    try:
        new = space if new_levels is None else SomeBins(space, new_levels)
    except ValueError as error:
        raise ValueError(f"new_levels: {error}") from error
    scorer = Scorer(score, source, rollouts)
    curriculum = ReplayCurriculum(new, scorer, rule, edit=edit, **numbers)
    curriculum.check(len(parts.seeds))
    return curriculum


def learnability(
    parts: Parts, score: str, source: Source, rollouts: int, **numbers: Any
) -> SelectionCurriculum:
    """Train on levels that stood out among many, and on new ones.

    The scorer as for :func:`replay`; further numbers: see :class:`SelectionCurriculum`.
    """
    return SelectionCurriculum(parts.task.space, Scorer(score, source, rollouts), **numbers)


def first_order_proposer(
    parts: Parts,
    target_levels: int = 256,
    step: float = 1.0,
    measure: str = "log_success",
    **numbers: Any,
) -> FirstOrderProposer:
    """Train on the draws of a policy that is rewarded for each problem, to first order.

    Args:
        parts: the task, and the Proposer's settings: of them the probes, the network, and of PPO
            how far a step goes (``adam_eps``, ``clip_epsilon``, ``max_grad_norm``).
        target_levels: see :class:`FirstOrderProposer`.
        step: the same.
        measure: the same.
        numbers: see :func:`_problem_policy`.
    """
    agent, settings = _problem_policy(parts, **numbers)
    return FirstOrderProposer(
        parts.task.space,
        parts.task.target,
        agent,
        settings,
        probe_levels=parts.proposer.probe_levels,
        target_levels=target_levels,
        step=step,
        measure=measure,
    )


def paired(parts: Parts, **numbers: Any) -> PairedProposer:
    """Train on the draws of a policy that is rewarded for the regret against a second Solver.

    Args:
        parts: the task, and the Proposer's settings as for :func:`first_order_proposer`.
        numbers: see :func:`_problem_policy`.
    """
    agent, settings = _problem_policy(parts, **numbers)
    task = parts.task
    return PairedProposer(
        task.space,
        task.target,
        agent,
        settings,
        probe_levels=parts.proposer.probe_levels,
        antagonist=TaskStudent(task, task.learner([Streams(parts.seeds[0], "antagonist")])),
    )


def _problem_policy(
    parts: Parts,
    epochs: int,
    learning_rate: float,
    entropy_coeff: float,
    checkpoint: str | None = None,
) -> tuple[ActorCritic, PPOSettings]:
    """A policy that draws each problem by itself, and how it learns.

    Args:
        parts: the task, and the Proposer's settings.
        epochs: gradient steps on the draws of each of the Solver's updates.
        learning_rate: of the policy.
        entropy_coeff: of the policy.
        checkpoint: of such a policy that has learnt; None to begin anew.
    """
    _one_solver(parts)
    task, chosen = parts.task, parts.proposer
    action = ProblemSettings()
    if isinstance(chosen.action, ProblemSettings):
        action = chosen.action
    if action.ratio == "joint":
        raise ValueError("proposer.action.ratio=joint: here each draw is rewarded by itself")
    with Streams(parts.seeds[0], "proposer").as_default("weights"):
        agent = proposer_agent(task, replace(chosen, observes=[], action=action))
    if checkpoint:
        _load(agent, checkpoint, [])
    numbers = replace(
        chosen.ppo, epochs=epochs, learning_rate=learning_rate, entropy_coeff=entropy_coeff
    )
    return agent, PPOSettings(horizon=1, **asdict(numbers))


def _one_solver(parts: Parts) -> None:
    if len(parts.seeds) > 1:
        raise ValueError(
            f"seeds={list(parts.seeds)}: a Proposer proposes to one Solver at a time; "
            "give one run for each, as in -m seed=0,1,2"
        )


def _load(agent: ActorCritic, checkpoint: str, observes: Sequence[str]) -> None:
    """Give a Proposer the weights of one that has learnt with the same network.

    Raises:
        ValueError: if the checkpoint holds no such Proposer.
        CheckpointError: if it cannot be read.
    """
    learnt = _curriculum_state(Path(checkpoint))
    try:
        observed = [name for name in learnt["observed"] if name != "probes"]
        load_agent(agent, TensorDict(learnt["proposer"]))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"checkpoint={checkpoint}: holds no Proposer with the network of these settings"
        ) from error
    if observed != list(observes):
        raise ValueError(
            f"proposer.observes={list(observes)}: the Proposer of checkpoint={checkpoint} has "
            f"learnt with {observed}"
        )


def _curriculum_state(path: Path) -> State:
    """The curriculum's part of a checkpoint, or of a run's newest one, or what it left of it."""
    if not path.exists():
        raise CheckpointError(f"checkpoint={path}: there is no such file or folder")
    if path.is_dir():
        latest = load_latest(path / "checkpoints")
        if latest is not None:
            return latest[1]["curriculum"]
        path = path / PROPOSER
        if not path.exists():
            raise CheckpointError(
                f"checkpoint={path.parent}: the folder holds no checkpoints and no {PROPOSER}"
            )
    return load_checkpoint(path)[1]["curriculum"]

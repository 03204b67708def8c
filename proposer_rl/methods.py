"""Methods: how a curriculum is put together from the task's parts. A method's config names one.

Each is a factory of the run's :class:`Components` and the config's numbers, which are mostly those
of the curriculum that it makes.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, get_type_hints

from tensordict import TensorDict

from proposer_rl.curricula import (
    Curriculum,
    Filtered,
    FirstOrderCurriculum,
    FirstOrderProposer,
    LearningProgressCurriculum,
    MixtureCurriculum,
    Modelled,
    PairedProposer,
    ProposerCurriculum,
    ProposerTrainer,
    ReplayCurriculum,
    ReplayRule,
    SampledFirstOrderCurriculum,
    SampledFirstOrderProposer,
    SamplingCurriculum,
    Schedule,
    Scorer,
    SelectionCurriculum,
    SomeBins,
    TaskStudent,
    TransportCurriculum,
)
from proposer_rl.curricula.scores import Source
from proposer_rl.learning import PPO, LeaveOneOutBaseline, MakeLoss, PPOSettings, load_agent
from proposer_rl.meta import rewards
from proposer_rl.meta.assembly import (
    ProblemSettings,
    ProposerSettings,
    meta_env,
    proposer_actions,
    proposer_agent,
    solver_view,
)
from proposer_rl.meta.replicas import ReplicasInWorkers, worker_env
from proposer_rl.meta.workers import WorkerSettings
from proposer_rl.models import ActorCritic
from proposer_rl.runs.checkpoint import CheckpointError, State, learnt_curriculum
from proposer_rl.settings import ArgumentError, Count, NotNegative, Positive, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Distribution, LocatedTarget, Space, Task

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")


class ProposerError(ArgumentError):
    """A setting of the Proposer is not allowed here; the line begins with its name."""


Workers = tuple[WorkerSettings, Callable[[str], Task]]
"""Other processes in which replicas of the Solver are trained, and what makes the task there.

Given its device; it can be pickled.
"""


class Components(NamedTuple):
    """What a method's factory gets.

    Attributes:
        task: what is to be learnt.
        proposer: the Proposer's settings.
        seeds: of the Solvers that are trained side by side; the first is that of a Proposer's
            weights.
        on_update: called with the number of an episode's updates after every one of the replicas
            that are trained in this process.
        workers: where else they are trained; None for this process.
    """

    task: Task
    proposer: ProposerSettings
    seeds: Sequence[int]
    on_update: Callable[[int], None] | None = None
    workers: Workers | None = None


def _takes_numbers_of(*makers: Any, given: str = "") -> Callable[[F], F]:
    """Put the numbers of a curriculum and its parts in the place of a factory's ``**numbers``.

    Args:
        makers: the parts' classes, and last the curriculum's, whose numbers have names alone.
        given: the name of one that the factory gives itself.
    """

    def decorate(factory: F) -> F:
        own = [p for p in inspect.signature(factory).parameters.values() if p.name != "numbers"]
        numbers = {}
        for make in makers:
            hints = get_type_hints(make.__init__, include_extras=True)
            for number in inspect.signature(make).parameters.values():
                known = {given, *(p.name for p in own)}
                named = number.kind is number.KEYWORD_ONLY or make is not makers[-1]
                if named and number.name not in known:
                    numbers[number.name] = number.replace(kind=number.KEYWORD_ONLY)
                    factory.__annotations__[number.name] = hints[number.name]
        every = sorted([*own, *numbers.values()], key=lambda p: p.kind)
        factory.__signature__ = inspect.Signature(every)  # type: ignore[attr-defined]
        return factory

    return decorate


@checked
@_takes_numbers_of(Filtered)
def filtered(
    curriculum: Curriculum,
    /,
    score: str = "learnability",
    source: Source = "exact",
    rollouts: Count = 8,
    **numbers: Any,
) -> Filtered:
    """A curriculum that draws more levels than are trained on, and keeps some.

    Args:
        curriculum: any.
        score: of the levels; see :class:`Scorer`.
        source: of the score.
        rollouts: on each level, from episodes.
        numbers: those of :class:`Filtered`.
    """
    return Filtered(curriculum, Scorer(score, source, rollouts), **numbers)


@checked
@_takes_numbers_of(Modelled)
def modelled(curriculum: Curriculum, task: Any, /, **numbers: Any) -> Modelled:
    """A curriculum that asks a model of outcomes wherever it would ask about performance.

    Raises:
        ArgumentError: if the task's levels have no features.
    """
    task.features(task.space.sample(1, Streams(0).generator())[None])
    return Modelled(curriculum, task.features, **numbers)


def _part(make: Callable[..., T], numbers: dict[str, Any]) -> T:
    """A part of a curriculum, of its own among the numbers; the others remain there."""
    own = inspect.signature(make).parameters.keys() & numbers.keys()
    return make(**{name: numbers.pop(name) for name in own})


def _of_task(make: Callable[..., Curriculum], *parts: str) -> Callable[..., Curriculum]:
    """The factory of a curriculum of which the task gives the first arguments, by these names."""

    @_takes_numbers_of(make)
    def factory(run: Components, /, **numbers: Any) -> Curriculum:
        if "target_shares" in parts:
            _require_target_shares(run.task)
        return make(*(getattr(run.task, part) for part in parts), **numbers)

    factory.__doc__ = f"Make a :class:`~{make.__module__}.{make.__qualname__}` for the run's task."
    return factory


def _require_target_shares(task: Task) -> None:
    if not isinstance(task, LocatedTarget):
        raise TypeError(
            f"this curriculum goes by where the target lies: {type(task).__name__} must "
            "define target_shares, the target as shares of the space's bins"
        )


target = _of_task(SamplingCurriculum, "target")
"""Train on the target distribution itself (the paper's baseline)."""
domain_randomization = _of_task(SamplingCurriculum, "space")
"""Train on levels drawn uniformly from the Proposer's space."""
alp_gmm = _of_task(MixtureCurriculum, "space")
learning_progress = _of_task(LearningProgressCurriculum, "space")
first_order_gain = _of_task(FirstOrderCurriculum, "space", "target")
currot = _of_task(TransportCurriculum, "space", "target_shares")
first_order_sampled = _of_task(SampledFirstOrderCurriculum, "space", "target_shares")


@checked
def schedule(components: Components, distributions: list[str], until: list[int]) -> Curriculum:
    """Train on named distributions one after another: a hand-designed curriculum.

    Args:
        components: the task.
        distributions: names, in order.
        until: updates after which each but the last ends.

    Raises:
        ArgumentError: for an unknown name, or as :class:`~proposer_rl.curricula.Schedule`.
    """
    known = components.task.distributions
    if any(name not in known for name in distributions):
        raise ArgumentError(f"distributions={distributions}: must be some of {sorted(known)}")
    return Schedule([SamplingCurriculum(known[name]) for name in distributions], until)


def proposer(
    components: Components,
    reward: rewards.Reward = rewards.log_success_gain,
    loss: MakeLoss | None = None,
    checkpoint: str | None = None,
) -> ProposerCurriculum:
    """Makes the paper's curriculum: a Proposer that is rewarded for each of the Solver's updates.

    Args:
        components: the task, and the Proposer's settings.
        reward: from an update to a number for each replica of the Solver.
        loss: of the Proposer; None for PPO's. See :class:`~proposer_rl.learning.PPO`.
        checkpoint: of a Proposer that has learnt, which goes on learning; see
            :func:`frozen_proposer`. None for a new one.

    Raises:
        ArgumentError: if the checkpoint holds no such Proposer, or cannot be read.
        TypeError: if the reward is no function.
        ProposerError: for settings of the Proposer that do not go together.
        ValueError: for several seeds.
    """
    if not callable(reward):
        raise TypeError(f"reward must be a function of a training step, got {reward!r}")
    _one_solver(components)
    task, config = components.task, components.proposer
    if config.advantage == "leave_one_out" and config.rollouts < 2:
        raise ProposerError(
            f"rollouts={config.rollouts}: must be at least 2 where advantage=leave_one_out"
        )
    streams = Streams(components.seeds[0], "proposer")
    env = meta_env(task, config, streams, reward, range(config.rollouts), components.on_update)
    unknown = [name for name in config.observes if name not in env.observation_spec.keys()]
    if unknown:
        raise ProposerError(
            f"observes={config.observes}: this task does not tell {', '.join(unknown)}; return and "
            "progress are available"
        )
    agent = _agent(components, config, checkpoint)
    numbers = PPOSettings(horizon=env.steps, **asdict(config.ppo))
    advantage = LeaveOneOutBaseline(numbers.gamma) if config.advantage == "leave_one_out" else None
    learner = PPO(env, agent, numbers, advantage=advantage, loss=loss)
    replicas = None
    if components.workers is not None:
        settings, make_task = components.workers
        make_env = partial(worker_env, make_task, config, streams, reward)
        replicas = ReplicasInWorkers(learner, make_env, settings)
    return ProposerTrainer(learner, replicas, config.advance).curriculum(config.own_action)


def task_difficulty(components: Components, checkpoint: str | None = None) -> ProposerCurriculum:
    """Makes the paper's ablation: a Proposer that is rewarded for the Solver's failures.

    No other reward can be put in the place of this one.
    """
    return proposer(components, rewards.task_difficulty, checkpoint=checkpoint)


def frozen_proposer(components: Components, checkpoint: str | None) -> ProposerCurriculum:
    """Makes a curriculum of a Proposer that has learnt in another run, and learns no more.

    Args:
        components: the task, and the settings of the Proposer's network and actions, which must be
            those of that run.
        checkpoint: a checkpoint of that run, its ``proposer.pt``, or its folder.

    Raises:
        ArgumentError: if nothing is named, it holds no such Proposer, or cannot be read.
        ValueError: for several seeds.
    """
    _one_solver(components)
    if not checkpoint:
        raise ArgumentError(
            f"checkpoint={checkpoint!r}: must name a run's folder or a checkpoint that has a "
            "Proposer"
        )
    task, config = components.task, components.proposer
    return ProposerCurriculum(
        _agent(components, config, checkpoint),
        solver_view(task, config),
        proposer_actions(task, config),
        meta_episode_length=config.meta_episode_length,
        action_repeat=config.action_repeat,
        own_action=config.own_action,
    )


@_takes_numbers_of(Scorer, ReplayRule, ReplayCurriculum, given="edit")
def replay(
    components: Components, new_levels: dict[str, list[float]] | None = None, **numbers: Any
) -> ReplayCurriculum:
    """Train on levels that are kept by their scores.

    Args:
        components: the task.
        new_levels: the bins that new levels come from: for some of the space's axes, by name, the
            values that count; None for the whole space.
        numbers: those of :class:`Scorer`, :class:`ReplayRule` and :class:`ReplayCurriculum`.
    """
    task = components.task
    try:
        new = task.space if new_levels is None else SomeBins(task.space, new_levels)
    except ArgumentError as error:
        raise ArgumentError(f"new_levels.{str(error).removeprefix('values.')}") from error
    scorer, rule = _part(Scorer, numbers), _part(ReplayRule, numbers)
    curriculum = ReplayCurriculum(new, scorer, rule, edit=getattr(task, "edit", None), **numbers)
    curriculum.check(len(components.seeds))
    return curriculum


@_takes_numbers_of(Scorer, SelectionCurriculum)
def learnability(components: Components, **numbers: Any) -> SelectionCurriculum:
    """Train on levels that stood out among many, and on new ones."""
    return SelectionCurriculum(components.task.space, _part(Scorer, numbers), **numbers)


@_takes_numbers_of(FirstOrderProposer, given="probe_levels")
def first_order_proposer(
    components: Components,
    epochs: Count,
    learning_rate: Positive,
    entropy_coeff: NotNegative,
    checkpoint: str | None = None,
    **numbers: Any,
) -> FirstOrderProposer:
    """Makes a Proposer that is rewarded for each problem with its first-order share of the gain.

    Args:
        components: the task, and the Proposer's settings, of which probes, network, and PPO's
            ``adam_eps``, ``clip_epsilon`` and ``max_grad_norm`` count.
        epochs: gradient steps on the draws of each of the Solver's updates.
        learning_rate: of the policy.
        entropy_coeff: of the policy.
        checkpoint: of such a policy that has learnt; None for a new one.
        numbers: see :class:`FirstOrderProposer`.
    """
    policy = _problem_policy(components, epochs, learning_rate, entropy_coeff, checkpoint)
    return FirstOrderProposer(*policy, probe_levels=components.proposer.probe_levels, **numbers)


@_takes_numbers_of(SampledFirstOrderProposer, given="probe_levels")
def first_order_proposer_sampled(
    components: Components,
    epochs: Count,
    learning_rate: Positive,
    entropy_coeff: NotNegative,
    checkpoint: str | None = None,
    **numbers: Any,
) -> SampledFirstOrderProposer:
    """Makes a Proposer that is rewarded by the Solver's own training episodes, without an oracle.

    The arguments are those of :func:`first_order_proposer`; ``numbers`` those of
    :class:`SampledFirstOrderProposer`.

    Raises:
        TypeError: if the task does not say where its target lies.
    """
    task: Any = components.task
    _require_target_shares(task)
    policy = _problem_policy(components, epochs, learning_rate, entropy_coeff, checkpoint)
    probes = components.proposer.probe_levels
    return SampledFirstOrderProposer(*policy, task.target_shares, probe_levels=probes, **numbers)


def paired(
    components: Components,
    epochs: Count,
    learning_rate: Positive,
    entropy_coeff: NotNegative,
    checkpoint: str | None = None,
) -> PairedProposer:
    """Makes a Proposer that is rewarded for each problem with the regret against a second Solver.

    The arguments are those of :func:`first_order_proposer`.

    Raises:
        ArgumentError: where episodes go on from update to update.
    """
    policy = _problem_policy(components, epochs, learning_rate, entropy_coeff, checkpoint)
    task, stream = components.task, Streams(components.seeds[0], "antagonist")
    second = task.learner([stream])
    if second.settings.continue_episodes:
        raise ArgumentError(
            "continue_episodes=True: the second Solver trains on whole levels, an update for each "
            "of the first one's; give False"
        )
    antagonist = TaskStudent(task, second)
    probes = components.proposer.probe_levels
    return PairedProposer(*policy, probe_levels=probes, antagonist=antagonist)


def _problem_policy(
    components: Components,
    epochs: int,
    learning_rate: float,
    entropy_coeff: float,
    checkpoint: str | None,
) -> tuple[Space, Distribution, ActorCritic, PPOSettings]:
    """Returns space, target, a policy that draws each problem by itself, and its PPO's numbers."""
    _one_solver(components)
    task, config = components.task, components.proposer
    action = config.action if isinstance(config.action, ProblemSettings) else ProblemSettings()
    if action.ratio == "joint":
        raise ProposerError("action.ratio=joint: here each draw is rewarded by itself")
    agent = _agent(components, replace(config, observes=[], action=action), checkpoint)
    numbers = replace(
        config.ppo, epochs=epochs, learning_rate=learning_rate, entropy_coeff=entropy_coeff
    )
    return task.space, task.target, agent, PPOSettings(horizon=1, **asdict(numbers))


def _agent(components: Components, config: ProposerSettings, checkpoint: str | None) -> ActorCritic:
    """Makes a Proposer, with the weights of one that has learnt with the same network if any.

    Args:
        components: the task, and the seed of new weights.
        config: the network, and what it observes.
        checkpoint: of a run, its ``proposer.pt``, or its folder; None for new weights.

    Raises:
        ArgumentError: if the checkpoint holds no such Proposer, or cannot be read.
    """
    with Streams(components.seeds[0], "proposer").as_default("weights"):
        agent = proposer_agent(components.task, config)
    if not checkpoint:
        return agent
    try:
        learnt = _with_proposer(learnt_curriculum(Path(checkpoint)))
        observed = [name for name in learnt["observed"] if name != "probes"]
        load_agent(agent, TensorDict(learnt["proposer"]))
    except CheckpointError as error:
        raise ArgumentError(f"checkpoint={checkpoint}: {error}") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ArgumentError(
            f"checkpoint={checkpoint}: holds no Proposer with the network of these settings"
        ) from error
    if observed != config.observes:
        raise ArgumentError(
            f"checkpoint={checkpoint}: its Proposer has learnt with observes={observed}, not "
            f"{config.observes}"
        )
    return agent


def _with_proposer(state: State) -> State:
    """Returns the state of the part that has a Proposer, where curricula hold others."""
    inner = (_with_proposer(part) for part in reversed(state.get("parts", [])))
    return state if "proposer" in state else next(filter(None, inner), {})


def _one_solver(components: Components) -> None:
    if len(components.seeds) > 1:
        raise ValueError(
            f"seeds={list(components.seeds)}: a Proposer proposes to one Solver at a time; give "
            "each a run of its own"
        )

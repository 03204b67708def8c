"""Makes a curriculum from its configuration and the parts of a run.

``_target_`` of a config names the curriculum's class, see :func:`make`. The functions here are for
curricula that one class and its settings do not make, such as those with a Proposer.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, NamedTuple, TypeVar, get_type_hints

from tensordict import TensorDict

from proposer_rl.curricula import (
    Curriculum,
    Filtered,
    FirstOrderProposer,
    Mixed,
    Modelled,
    PairedProposer,
    ProposerCurriculum,
    ProposerTrainer,
    ReplayRule,
    SamplingCurriculum,
    Schedule,
    Scorer,
)
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
from proposer_rl.recipes import (
    REFERENCE,
    Recipe,
    available,
    file_content,
    filter_content,
    merged,
)
from proposer_rl.runs.checkpoint import CheckpointError, State, learnt_curriculum
from proposer_rl.settings import ArgumentError, Count, NotNegative, Positive, arguments, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Distribution, Space, Task

T = TypeVar("T")


class ProposerError(ArgumentError):
    """A setting of the Proposer is not allowed here; the line begins with its name."""


Workers = tuple[WorkerSettings, Callable[[str], Task]]
"""Other processes in which replicas of the Solver are trained, and what makes the task there.

Given its device; it can be pickled.
"""


class Components(NamedTuple):
    """The parts of a run that curricula are made of.

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


OF_A_RUN = ("task", "proposer", "seeds")
OF_A_TASK = ("space", "target", "target_shares", "features", "inputs", "edit")
PARTS = (Scorer, ReplayRule)  # of curricula, made of settings that stand beside the curriculum's


class UnfitTaskError(TypeError):
    """A curriculum asks for something that the task does not define."""


def make(
    target: Callable[..., T], settings: Mapping[str, Any], run: Components, /, **given: Any
) -> T:
    """Calls a class or function with settings that its signature allows, and with the run's parts.

    It gets by the names of its parameters:

    - ``task``, ``proposer`` and ``seeds`` of the run; ``space``, ``target``, ``target_shares``,
      ``features``, ``inputs`` and ``edit`` of the task, those with a default where it has them;
    - a :class:`Scorer` or :class:`ReplayRule`, made of the settings that these take;
    - the other settings.

    A function whose first parameter has none of these names, no default, and no type or the type
    :class:`Components`, gets the run itself there, and the settings alone.

    Args:
        target: what is called.
        settings: by name.
        run: what the run has.
        given: further arguments.

    Raises:
        ArgumentError: as :func:`~proposer_rl.settings.arguments`.
        UnfitTaskError: if the task lacks what is asked of it.
    """
    parameters = inspect.signature(target).parameters
    hints = get_type_hints(target.__init__ if inspect.isclass(target) else target)
    try:
        for first in [*parameters.values()][:1]:
            free = first.name not in {*OF_A_RUN, *OF_A_TASK, *given, *settings}
            asks = first.kind <= first.POSITIONAL_OR_KEYWORD and first.default is first.empty
            if free and asks and hints.get(first.name, Any) in (Any, Components):
                return target(run, **arguments(target, settings, [first.name]))
        for name in [name for name in parameters if name not in given]:
            if name in OF_A_RUN:
                given[name] = getattr(run, name)
            elif name in OF_A_TASK:
                needed = parameters[name].default is inspect.Parameter.empty
                with nullcontext() if needed else suppress(AttributeError, ArgumentError):
                    given[name] = getattr(run.task, name)
        parts = {
            name: (part, [*inspect.signature(part).parameters])
            for name, hint in hints.items()
            for part in PARTS
            if hint in (part, part | None) and name not in given
        }
        theirs = [name for _, names in parts.values() for name in names]
        read = arguments(target, settings, [*given, *parts], theirs)
        for name, (part, names) in parts.items():
            own = {key: read.pop(key) for key in names if key in read}
            given[name] = part(**arguments(part, own))
        return target(**given, **read)
    except AttributeError as error:
        if error.obj is not run.task:
            raise
        raise UnfitTaskError(
            f"needs {error.name} of a task, which {type(run.task).__name__} does not define"
        ) from error


def filtered(curriculum: Curriculum, settings: Mapping[str, Any], run: Components) -> Filtered:
    """Makes a curriculum that draws more levels than are trained on, and keeps some.

    What the settings do not say is as in ``conf/filter/learnability.yaml``.
    """
    settings = file_content("filter/learnability")["filter"] | settings
    return make(Filtered, settings, run, curriculum=curriculum)


def modelled(curriculum: Curriculum, settings: Mapping[str, Any], run: Components) -> Modelled:
    """Makes a curriculum that asks a model of outcomes wherever it would ask about performance.

    Raises:
        ArgumentError: if the task's levels have no features.
    """
    run.task.features(run.task.space.sample(1, Streams(0).generator())[None])
    return make(Modelled, settings, run, curriculum=curriculum)


def recipe_settings(recipe: Recipe) -> dict[str, Any]:
    """Returns the settings of a recipe by key, such as ``curriculum``, over those of its file."""
    if recipe.target:
        return {"curriculum": {**recipe.settings, "_target_": recipe.target}}
    file = file_content(f"method/{recipe.name}")
    # What a file makes of a class of its own is the default of the function, too.
    there = {
        name: value
        for name, value in file["curriculum"].items()
        if not (isinstance(value, Mapping) and "_target_" in value)
    }
    return merged({**file, "curriculum": there}, recipe.by_key())


def around(curriculum: Curriculum, settings: Mapping[str, Any], run: Components) -> Curriculum:
    """Returns a curriculum with the filter and the model around it that settings by key have."""
    if settings.get("filter") is not None:
        curriculum = filtered(curriculum, settings["filter"], run)
    if settings.get("model") is not None:
        curriculum = modelled(curriculum, settings["model"], run)
    return curriculum


def mixture(components: Components, parts: dict[str, dict[str, Any]]) -> Mixed:
    """Makes batches of which each of some methods has its share.

    Args:
        components: of the run.
        parts: by the names of methods, the settings that differ from their files'; besides
            ``share``, of the levels of a batch (1; with 0 the method is left out), and ``filter``,
            as :func:`~proposer_rl.recipes.filter_content` takes it.

    Raises:
        ArgumentError: for an unknown method, a setting that it does not have, one that its file
            takes from elsewhere and that is not given, or shares that are all zero.
    """
    for name in parts:
        if name not in available("method"):
            raise ArgumentError(
                f"parts.{name}: unknown; there are: {', '.join(available('method'))}"
            )
    made: list[tuple[Curriculum, float]] = []
    for name, given in parts.items():
        try:
            made += _part(components, name, **given)
        except ArgumentError as error:
            raise ArgumentError(f"parts.{name}.{error}") from error
    if not made:
        raise ArgumentError(f"parts={list(parts)}: must have one whose share is above 0")
    curricula, shares = zip(*made, strict=True)
    return Mixed(list(curricula), list(shares))


@checked
def _part(
    components: Components,
    name: str,
    /,
    *,
    share: NotNegative = 1.0,
    filter: str | dict[str, Any] | None = None,
    **given: Any,
) -> list[tuple[Curriculum, float]]:
    """Returns a part of a mixture and its share, or nothing if that is 0."""
    if not share:
        return []
    settings = recipe_settings(Recipe("method", name, given))
    if filter is not None:
        settings = merged(settings, filter_content(filter))
    own = settings["curriculum"]
    for key, value in own.items():
        if isinstance(value, str) and (reference := REFERENCE.fullmatch(value)):
            raise ArgumentError(f"{key}: missing; alone the method has that of {reference[1]}")
    curriculum: Curriculum = make(resolve_name(own.pop("_target_")), own, components)
    return [(around(curriculum, settings, components), share)]


def target(target: Distribution) -> SamplingCurriculum:
    """Trains on the target distribution itself: the paper's baseline."""
    return SamplingCurriculum(target)


def domain_randomization(space: Space) -> SamplingCurriculum:
    """Trains on levels drawn uniformly from the Proposer's space."""
    return SamplingCurriculum(space)


@checked
def schedule(components: Components, distributions: list[str], until: list[int]) -> Curriculum:
    """Trains on named distributions one after another: a hand-designed curriculum.

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
        ProposerError: for settings of the Proposer that do not go together.
        ValueError: for several seeds.
    """
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
    return ProposerTrainer(learner, replicas).curriculum(config.own_action)


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


def first_order_proposer(
    components: Components,
    epochs: Count,
    learning_rate: Positive,
    entropy_coeff: NotNegative,
    checkpoint: str | None = None,
    **settings: Any,
) -> FirstOrderProposer:
    """Makes a Proposer that is rewarded for each problem with its first-order share of the gain.

    Args:
        components: the task, and the Proposer's settings, of which probes, network, and PPO's
            ``adam_eps``, ``clip_epsilon`` and ``max_grad_norm`` count.
        epochs: gradient steps on the draws of each of the Solver's updates.
        learning_rate: of the policy.
        entropy_coeff: of the policy.
        checkpoint: of such a policy that has learnt; None for a new one.
        settings: see :class:`FirstOrderProposer`.
    """
    policy = _problem_policy(components, epochs, learning_rate, entropy_coeff, checkpoint)
    return make(FirstOrderProposer, settings, components, **policy)


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
    return make(PairedProposer, {}, components, antagonist=second, **policy)


def _problem_policy(
    components: Components,
    epochs: int,
    learning_rate: float,
    entropy_coeff: float,
    checkpoint: str | None,
) -> dict[str, Any]:
    """Returns a policy that draws each problem by itself, its PPO's numbers, and its probes."""
    _one_solver(components)
    config = components.proposer
    action = config.action if isinstance(config.action, ProblemSettings) else ProblemSettings()
    if action.ratio == "joint":
        raise ProposerError("action.ratio=joint: here each draw is rewarded by itself")
    agent = _agent(components, replace(config, observes=[], action=action), checkpoint)
    numbers = replace(
        config.ppo, epochs=epochs, learning_rate=learning_rate, entropy_coeff=entropy_coeff
    )
    settings = PPOSettings(horizon=1, **asdict(numbers))
    return {"agent": agent, "settings": settings, "probe_levels": config.probe_levels}


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
    except (CheckpointError, OSError) as error:
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

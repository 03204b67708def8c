"""Builds a curriculum from its configuration and the parts of a run.

:func:`build` calls the class or function that a configuration names. The functions after it are
named in configurations, too: they make curricula that have no class of their own, and those with a
Proposer.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

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
    SamplingCurriculum,
    Schedule,
)
from proposer_rl.learning import PPO, LeaveOneOutBaseline, MakeLoss, PPOSettings, load_agent
from proposer_rl.meta import rewards
from proposer_rl.meta.assembly import Components as Components
from proposer_rl.meta.assembly import (
    ProblemSettings,
    ProposerSettings,
    meta_env,
    proposer_actions,
    proposer_agent,
    solver_view,
)
from proposer_rl.meta.first_order import TargetMeasure
from proposer_rl.meta.replicas import ReplicasInWorkers, worker_env
from proposer_rl.models import ActorCritic
from proposer_rl.recipes import (
    NO_TASK,
    Recipe,
    available,
    composed,
    maker,
    plain_values,
    recipe_function,
)
from proposer_rl.runs.checkpoint import State, learnt_curriculum
from proposer_rl.settings import (
    ArgumentError,
    Count,
    NotNegative,
    Positive,
    WholeKeyError,
    checked,
    configured,
    refuse_unknown,
    schema,
    with_defaults,
    within,
)
from proposer_rl.streams import Streams

# Bad input raises these in the classes and functions that a configuration names.
INPUT_ERRORS = (ValueError, TypeError, NameError)
# These are put around a curriculum, each by its key in the configuration.
AROUND: dict[str, Callable[..., Curriculum]] = {
    "filter": Filtered.around,
    "model": Modelled.around,
}


def build(config: Mapping[str, Any], run: Components) -> Curriculum:
    """Builds a curriculum for a run, with the filter and the model around it, if any.

    Args:
        config: with ``curriculum``, and perhaps ``filter`` and ``model``. ``_target_`` of the
            curriculum names a class with a method ``create``, or a function. It is called with the
            run; the other settings are its keyword-only arguments.
        run: the parts of the run.

    Raises:
        ArgumentError: naming a key that is not allowed, and what is; if the task lacks something
            that the curriculum uses.
    """
    make, settings = maker("curriculum", config["curriculum"])
    with within("curriculum", *INPUT_ERRORS):
        try:
            curriculum: Curriculum = make(run, **configured(make, settings))
        except AttributeError as error:
            if error.obj is not run.task:
                raise
            said = f"needs {error.name} of a task, which {type(run.task).__name__} does not define"
            raise TypeError(said) from error
    return around(curriculum, config, run)


def around(curriculum: Curriculum, config: Mapping[str, Any], run: Components) -> Curriculum:
    """Returns a curriculum with the filter and the model of a configuration around it."""
    for key, make in AROUND.items():
        if config.get(key) is not None:
            with within(key, ValueError):
                curriculum = make(curriculum, run, **configured(make, config[key]))
    return curriculum


def completed(config: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a configuration with all defaults of what :func:`build` makes of it."""
    found, curriculum = dict(config), config.get("curriculum")
    if isinstance(curriculum, Mapping):
        make, _ = maker("curriculum", {"_target_": curriculum.get("_target_")})
        found["curriculum"] = {"_target_": None, **with_defaults(make, curriculum)}
    for key, make in AROUND.items():
        if isinstance(config.get(key), Mapping):
            found[key] = with_defaults(make, config[key])
    return found


def filter_asked(filter: Mapping[str, Any] | str | None) -> tuple[list[str], dict[str, Any]]:
    """Returns a filter as words for Hydra and settings to be merged into what it composes.

    Args:
        filter: a name in ``conf/filter``, or settings. If settings of a model are among them, such
            as ``labels``, the others have the defaults of ``conf/filter/model.yaml``.
    """
    if filter is None:
        return [], {}
    if isinstance(filter, str):
        return [f"filter={filter}"], {}
    model = {name: value for name, value in filter.items() if name in schema(Modelled.around)}
    rest = {name: value for name, value in filter.items() if name not in model}
    return (["filter=model"], {"filter": rest, "model": model}) if model else ([], {"filter": rest})


def asked(
    recipe: Recipe | None, filter: Mapping[str, Any] | str | None, resolve: bool = True
) -> dict[str, Any]:
    """Returns the configuration of a curriculum and a filter, for :func:`build`.

    Args:
        recipe: of the curriculum; None for a filter alone.
        filter: as for :func:`filter_asked`.
        resolve: whether to replace references such as ``${pool.capacity}`` by the values in
            ``conf/train.yaml``.
    """
    words, settings = filter_asked(filter)
    made = recipe or Recipe("method", "")
    config = composed([NO_TASK, *made.words, *words], made.settings, settings)
    keys = ("curriculum", *AROUND)
    return {key: plain_values(config[key], resolve) for key in keys if config[key] is not None}


def mixture(run: Components, *, parts: dict[str, dict[str, Any]]) -> Mixed:
    """Makes batches of which several methods each have a share.

    Args:
        run: the parts of the run.
        parts: by the names of methods, the settings that differ from their defaults. Besides these,
            ``share`` of the levels of a batch (1; with 0 the method is left out), and ``filter``,
            as for :func:`filter_asked`.

    Raises:
        ArgumentError: for an unknown method or setting, or if all shares are zero.
    """
    made: list[tuple[Curriculum, float]] = []
    with within("parts"):
        refuse_unknown(parts, available("method"))
        for name, given in parts.items():
            with within(name):
                made += _part(run, name, **given)
    return Mixed([curriculum for curriculum, _ in made], [share for _, share in made])


@checked
def _part(
    run: Components,
    name: str,
    /,
    *,
    share: NotNegative = 1.0,
    filter: str | dict[str, Any] | None = None,
    **given: Any,
) -> list[tuple[Curriculum, float]]:
    """Returns a part of a mixture and its share; nothing if that is 0."""
    if not share:
        return []
    recipe = recipe_function("method", name, Modelled.around)(**given)
    return [(build(asked(recipe, filter, resolve=False), run), share)]


def target(run: Components) -> SamplingCurriculum:
    """Trains on the target distribution itself: the paper's baseline."""
    return SamplingCurriculum(run.task.target)


def domain_randomization(run: Components) -> SamplingCurriculum:
    """Trains on levels drawn uniformly from the Proposer's space."""
    return SamplingCurriculum(run.task.space)


def schedule(run: Components, *, distributions: list[str], until: list[int]) -> Schedule:
    """Trains on named distributions one after another: a hand-designed curriculum.

    Args:
        run: the parts of the run.
        distributions: names, in order.
        until: updates after which each but the last ends.

    Raises:
        ArgumentError: for an unknown name, or as :class:`~proposer_rl.curricula.Schedule`.
    """
    known = run.task.distributions
    with within("distributions"):
        refuse_unknown(distributions, known)
    return Schedule([SamplingCurriculum(known[name]) for name in distributions], until)


def proposer(
    run: Components,
    loss: MakeLoss | None = None,
    *,
    reward: rewards.Reward,
    checkpoint: str | None = None,
) -> ProposerCurriculum:
    """Makes the paper's curriculum: a Proposer that is rewarded for each of the Solver's updates.

    Args:
        run: the task, and the Proposer's settings.
        loss: of the Proposer; None for PPO's. See :class:`~proposer_rl.learning.PPO`.
        reward: maps an update to a number for each replica of the Solver.
        checkpoint: of a trained Proposer, which goes on learning; see :func:`frozen_proposer`. None
            for a new one.

    Raises:
        ArgumentError: if the checkpoint holds no such Proposer, or cannot be read.
        WholeKeyError: for settings of the Proposer that contradict each other.
    """
    task, config = run.task, run.proposer
    if config.advantage == "leave_one_out" and config.rollouts < 2:
        raise WholeKeyError(
            f"proposer.rollouts={config.rollouts}: must be at least 2 where advantage=leave_one_out"
        )
    streams = Streams(run.seed, "proposer")
    env = meta_env(task, config, streams, reward, range(config.rollouts), run.on_update)
    unknown = [name for name in config.observes if name not in env.observation_spec.keys()]
    if unknown:
        raise WholeKeyError(
            f"proposer.observes={config.observes}: this task has no {', '.join(unknown)}; return "
            "and progress are available"
        )
    agent = _agent(run, config, checkpoint)
    numbers = PPOSettings(horizon=env.steps, **asdict(config.ppo))
    advantage = LeaveOneOutBaseline(numbers.gamma) if config.advantage == "leave_one_out" else None
    learner = PPO(env, agent, numbers, advantage=advantage, loss=loss)
    replicas = None
    if run.workers is not None:
        settings, make_task = run.workers
        make_env = partial(worker_env, make_task, config, streams, reward)
        replicas = ReplicasInWorkers(learner, make_env, settings)
    return ProposerTrainer(learner, replicas).curriculum(config.own_action)


def task_difficulty(run: Components, *, checkpoint: str | None = None) -> ProposerCurriculum:
    """Makes the paper's ablation: a Proposer that is rewarded for the Solver's failures.

    Its reward is fixed, so that an ablation cannot replace it under the same name.
    """
    return proposer(run, reward=rewards.task_difficulty, checkpoint=checkpoint)


def frozen_proposer(run: Components, *, checkpoint: str) -> ProposerCurriculum:
    """Makes a curriculum of a Proposer that was trained in another run, and learns no more.

    Args:
        run: the task, and the settings of the Proposer's network and actions, which must be
            those of that run.
        checkpoint: a checkpoint of that run, its ``proposer.pt``, or its folder.

    Raises:
        ArgumentError: if it holds no such Proposer, or cannot be read.
    """
    task, config = run.task, run.proposer
    return ProposerCurriculum(
        _agent(run, config, checkpoint),
        solver_view(task, config),
        proposer_actions(task, config),
        meta_episode_length=config.meta_episode_length,
        action_repeat=config.action_repeat,
        own_action=config.own_action,
    )


def first_order_proposer(
    run: Components,
    *,
    checkpoint: str | None = None,
    target_levels: Count = 256,
    step: Positive = 1.0,
    measure: TargetMeasure = "log_success",
    epochs: Count = 4,
    learning_rate: Positive = 3e-3,
    entropy_coeff: NotNegative = 0.1,
) -> FirstOrderProposer:
    """Makes a Proposer that is rewarded for each problem with its first-order share of the gain.

    Args:
        run: the task, and the Proposer's settings. Only its probes, its network and PPO's
            ``adam_eps``, ``clip_epsilon`` and ``max_grad_norm`` have an effect.
        checkpoint: of such a policy that has learnt; None for a new one.
        target_levels: see :class:`FirstOrderProposer`, as for the next two.
        step: of the finite differences from which the rewards are computed.
        measure: of the target's performance.
        epochs: gradient steps on the draws of each of the Solver's updates.
        learning_rate: of the policy.
        entropy_coeff: of the policy.
    """
    policy = _problem_policy(run, epochs, learning_rate, entropy_coeff, checkpoint)
    policy |= {"target_levels": target_levels, "step": step, "measure": measure}
    return FirstOrderProposer(run.task.space, run.task.target, **policy)


def paired(
    run: Components,
    *,
    checkpoint: str | None = None,
    epochs: Count = 4,
    learning_rate: Positive = 3e-3,
    entropy_coeff: NotNegative = 0.1,
) -> PairedProposer:
    """Makes a Proposer that is rewarded for each problem with the regret against a second Solver.

    The arguments are those of :func:`first_order_proposer`.

    Raises:
        ArgumentError: where episodes continue from update to update.
    """
    policy = _problem_policy(run, epochs, learning_rate, entropy_coeff, checkpoint)
    task, stream = run.task, Streams(run.seed, "antagonist")
    second = task.learner([stream])
    if second.settings.continue_episodes:
        raise ArgumentError(
            "continue_episodes=True: the second Solver trains on whole levels, an update for each "
            "of the first one's; give False"
        )
    return PairedProposer(task.space, task.target, **policy, task=task, antagonist=second)


def _problem_policy(
    run: Components,
    epochs: int,
    learning_rate: float,
    entropy_coeff: float,
    checkpoint: str | None,
) -> dict[str, Any]:
    """Returns a policy that draws each problem by itself, its PPO's numbers, and its probes."""
    config = run.proposer
    action = config.action if isinstance(config.action, ProblemSettings) else ProblemSettings()
    if action.ratio == "joint":
        raise WholeKeyError("proposer.action.ratio=joint: here each draw is rewarded by itself")
    agent = _agent(run, replace(config, observes=[], action=action), checkpoint)
    numbers = replace(
        config.ppo, epochs=epochs, learning_rate=learning_rate, entropy_coeff=entropy_coeff
    )
    settings = PPOSettings(horizon=1, **asdict(numbers))
    return {"agent": agent, "settings": settings, "probe_levels": config.probe_levels}


def _agent(run: Components, config: ProposerSettings, checkpoint: str | None) -> ActorCritic:
    """Makes a Proposer, with trained weights from a checkpoint, if any.

    Args:
        run: the task, and the seed of new weights.
        config: the network, and what it observes.
        checkpoint: of a run, its ``proposer.pt``, or its folder; None for new weights.

    Raises:
        ArgumentError: if the checkpoint holds no Proposer with this network, or cannot be read.
    """
    with Streams(run.seed, "proposer").as_default("weights"):
        agent = proposer_agent(run.task, config)
    if not checkpoint:
        return agent
    with within("checkpoint", OSError, ValueError, lead=f"checkpoint={checkpoint}: "):
        learnt = _with_proposer(learnt_curriculum(Path(checkpoint)))
        load_agent(agent, TensorDict(learnt.get("proposer", {})))
        observed = [name for name in learnt["observed"] if name != "probes"]
        if observed != config.observes:
            raise ValueError(
                f"its Proposer has learnt with observes={observed}, not {config.observes}"
            )
    return agent


def _with_proposer(state: State) -> State:
    """Returns the part of a curriculum's state that has a Proposer; empty if none has."""
    inner = (_with_proposer(part) for part in reversed(state.get("parts", [])))
    return state if "proposer" in state else next(filter(None, inner), {})

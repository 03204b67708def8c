"""What an argument may be is said once, in the signature; and the settings that are no task's.

:func:`checked` holds a constructor or a factory to the types and bounds of its own signature, for
whoever calls it; the command line asks the same of what it makes, by :func:`arguments`, and puts
its key before the line. The settings are frozen dataclasses that are checked in this way, too.

``conf/train.yaml`` lists the same values (a test compares them) and says in a line what each does.
A rule that joins several settings stands where the object is built that needs it.
"""

from __future__ import annotations

import functools
import inspect
import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import (
    Annotated,
    Any,
    Literal,
    ParamSpec,
    TypeVar,
    dataclass_transform,
    get_type_hints,
)

from annotated_types import Ge, Gt, Interval
from pydantic import ConfigDict, Discriminator, TypeAdapter, ValidationError
from pydantic.errors import PydanticUserError

T = TypeVar("T")
P = ParamSpec("P")

Count = Annotated[int, Interval(ge=1, le=1_000_000)]
"""Of what is counted, at least one: more than a million would not fit, or never come to pass."""
Share = Annotated[float, Interval(ge=0, le=1)]
"""A part of a whole, or a probability."""
Decay = Annotated[float, Interval(ge=0, lt=1)]
"""The share of the old in a running average."""
Positive = Annotated[float, Gt(0)]
"""A number above zero."""
NotNegative = Annotated[float, Ge(0)]
"""Zero, or a number above it."""


SHOULD = "input should be "  # as pydantic begins most of its lines

BY_KIND = Discriminator("kind")
"""Of a union of settings, each of which has an entry ``kind`` of its own."""


class ArgumentError(ValueError):
    """An argument is not allowed: one line ``name=value: what is allowed``.

    Rules that join several arguments raise it in the same form. A callable that passes on what it
    was given as one argument puts that argument's name and a dot before the line.
    """


def checked(function: Callable[P, T]) -> Callable[P, T]:
    """Hold every call of a function to its signature; of a class, decorate ``__init__``.

    What may be given stands in the annotations alone: ``step: Positive``,
    ``source: Literal["exact", "episodes"]``, ``every: Annotated[int, Interval(ge=1, le=100)]``.
    See :func:`arguments` for how values are read. Defaults are not checked.

    Raises:
        ArgumentError: by the decorated function, for the first argument that is not allowed.

    Example:
        >>> @checked
        ... def softmax(scores: list[float], temperature: Positive = 1.0) -> float:
        ...     return max(scores) / temperature
        >>> softmax([1, 2], temperature=0)
        Traceback (most recent call last):
        ...
        proposer_rl.settings.ArgumentError: temperature=0: input should be greater than 0
    """
    signature = inspect.signature(function)
    variadic = [
        p.name for p in signature.parameters.values() if p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
    ]

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        _check_names(function, kwargs, (), missing=False)
        bound = signature.bind(*args, **kwargs)
        given = {name: value for name, value in bound.arguments.items() if name not in variadic}
        bound.arguments.update(_checked_values(function, given))
        return function(*bound.args, **bound.kwargs)

    return call


def signed(made: type[T]) -> type[T]:
    """Show a class's constructor as its signature, which TorchRL's metaclass of environments hides.

    Example:
        >>> from torchrl.envs import EnvBase
        >>> @signed
        ... class Env(EnvBase):
        ...     def __init__(self, levels, *, max_steps=25): ...
        >>> inspect.signature(Env)
        <Signature (levels, *, max_steps=25)>
    """
    _, *parameters = inspect.signature(made.__init__).parameters.values()
    made.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return made


def arguments(
    function: Callable[..., Any], values: Mapping[str, Any], given: Collection[str] = ()
) -> dict[str, Any]:
    """Check arguments against the signature of what will be called with them.

    Numbers are read strictly (true is no number, "3" is none, 1.0 no integer), infinity and NaN are
    refused, a list may stand for a tuple and a mapping for settings. An argument whose type says
    nothing that could be checked, such as a task, is passed on as it is.

    Args:
        function: a class or function.
        values: by name.
        given: names of arguments that it gets otherwise.

    Returns:
        The same arguments, with the values as the signature's types have them.

    Raises:
        ArgumentError: for the first value that is not allowed, and what is; for an unknown name,
            and which there are; for a name that is missing.
        NameError: if the annotations name what cannot be found.

    Example:
        >>> def learn(rate: Positive, source: Literal["exact", "episodes"] = "exact"): ...
        >>> arguments(learn, {"rate": 1})
        {'rate': 1.0}
        >>> arguments(learn, {"rat": 1})
        Traceback (most recent call last):
        ...
        proposer_rl.settings.ArgumentError: rat: unknown; there are: rate, source
    """
    _check_names(function, values, given)
    return _checked_values(function, values)


def _check_names(
    function: Callable[..., Any],
    values: Mapping[str, Any],
    given: Collection[str],
    missing: bool = True,
) -> None:
    parameters = inspect.signature(function).parameters.values()
    named = [p for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    known = [p.name for p in named if p.name not in ("self", *given)]
    takes_any = any(p.kind is p.VAR_KEYWORD for p in parameters)
    for name in values:
        if name not in known and not takes_any:
            available = f"there are: {', '.join(known)}" if known else "there are none"
            raise ArgumentError(f"{name}: unknown; {available}")
    for parameter in named:
        asked = parameter.default is parameter.empty and parameter.name in known
        if missing and asked and parameter.name not in values:
            raise ArgumentError(f"{parameter.name}: missing")


def _checked_values(function: Callable[..., Any], values: Mapping[str, Any]) -> dict[str, Any]:
    adapters = _adapters(function)
    read = dict(values)
    for name, adapter in adapters.items():  # in the signature's order: the first is told
        if name in values and adapter is not None:
            read[name] = _read(name, values[name], adapter)
    return read


@functools.cache
def _adapters(function: Callable[..., Any]) -> dict[str, TypeAdapter[Any] | None]:
    typed = function.__init__ if inspect.isclass(function) else function
    hints = get_type_hints(typed, include_extras=True)
    hints.pop("return", None)
    return {name: _adapter(hint) for name, hint in hints.items()}


def _adapter(hint: Any) -> TypeAdapter[Any] | None:
    """What reads values of a type; None for one that pydantic knows nothing of, as a task."""
    for config in (ConfigDict(allow_inf_nan=False), None):  # a dataclass has its own
        try:
            return TypeAdapter(hint, config=config)
        except PydanticUserError:
            continue
    return None


def _read(name: str, value: Any, adapter: TypeAdapter[Any]) -> Any:
    try:
        text = json.dumps(value)
    except (TypeError, ValueError, RecursionError):
        text = None
    try:
        # As JSON, pydantic can be strict: true is no number, "3" neither, but a list is a tuple.
        if text is not None:
            return adapter.validate_json(text, strict=True)
        return adapter.validate_python(value, strict=True)
    except ValidationError as error:
        raise ArgumentError(_first_line(error, name, value)) from error


def _first_line(error: ValidationError, name: str, value: Any) -> str:
    # The first that is wrong; of a union each member says something, and those that went deepest
    # into the value know most of it.
    all_ = [(details, *_place(details, value)) for details in error.errors()]
    within = [one for one in all_ if one[1][: len(all_[0][1])] == all_[0][1]]
    details, loc, folder = max(within, key=lambda one: len(one[1]))
    key = ".".join(map(str, [name, *loc]))
    lines = [one["msg"].removeprefix("Value error, ") for one, place, _ in within if place == loc]
    message, *others = dict.fromkeys(f"{line[0].lower()}{line[1:]}" for line in lines)
    message += "".join(f", or {other.removeprefix(SHOULD)}" for other in others)
    if details["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        known = ", ".join(sorted(map(str, folder.keys() - {loc[-1]})))
        return f"{key}: unknown" + (f"; there are: {known}" if known else "")
    if details["type"] == "missing":
        return f"{key}: missing"
    given = repr(details["input"])
    given = given if len(given) <= 80 else f"{given[:77]}..."
    return f"{key}={given}: {message}"


def _place(details: Any, value: Any) -> tuple[list[int | str], Any]:
    """Where in a value something is wrong, and the innermost container around that place."""
    loc: list[int | str] = []
    folder = inner = value
    for part in details["loc"]:
        try:
            folder, inner = inner, inner[part]
        except (LookupError, TypeError):
            if details["type"] != "missing":  # a union's member is named, too, and is no key
                continue
        loc.append(part)
    return loc, folder


@dataclass_transform(frozen_default=True, kw_only_default=True)
def settings(cls: type[T]) -> type[T]:
    """A frozen, keyword-only dataclass whose constructor is :func:`checked`.

    Ranges stand in the annotations (``Annotated[int, Ge(1)]``).
    """
    decorated = dataclass(frozen=True, kw_only=True)(cls)
    decorated.__pydantic_config__ = {"extra": "forbid", "allow_inf_nan": False}  # type: ignore[attr-defined]
    decorated.__init__ = checked(decorated.__init__)  # type: ignore[method-assign]
    return decorated


@settings
class LearningSettings:
    """PPO's numbers but for the horizon; the defaults are the paper's for the Solver.

    Attributes:
        updates: updates on one batch; each computes advantages anew, then runs ``epochs``.
        epochs: passes of an update through its batch, each a gradient step where the batch is not
            cut in parts.
        learning_rate, adam_eps: Adam's step size and denominator offset.
        gamma, lmbda: discount, and GAE's weight of longer returns (Schulman et al. 2016, eq. 16).
        clip_epsilon: the ratio is clipped to 1 +- this (Schulman et al. 2017, eq. 7).
        entropy_coeff, critic_coeff: weights of the entropy bonus and of the squared value error.
        max_grad_norm: largest gradient norm of one copy.
        normalize_advantage: standardise advantages over what a gradient step of a copy is made on.
    """

    updates: Annotated[int, Ge(1)] = 1
    epochs: Annotated[int, Ge(1)] = 8
    learning_rate: Annotated[float, Gt(0)] = 2.5e-4
    adam_eps: Annotated[float, Gt(0)] = 1e-5
    gamma: Annotated[float, Interval(ge=0, le=1)] = 0.99
    lmbda: Annotated[float, Interval(ge=0, le=1)] = 0.95
    clip_epsilon: Annotated[float, Interval(gt=0, lt=1)] = 0.2
    entropy_coeff: Annotated[float, Ge(0)] = 0.01
    critic_coeff: Annotated[float, Ge(0)] = 0.5
    max_grad_norm: Annotated[float, Gt(0)] = 1.0
    normalize_advantage: bool = True


@settings
class PPOSettings(LearningSettings):
    """PPO's numbers, and how it goes through a batch.

    Attributes:
        horizon: steps T collected from every environment before an update.
        continue_episodes: whether episodes go on from rollout to rollout, and a new level begins
            where one ends; otherwise every rollout begins with its levels.
        normalize_observations: the numbers that are observed are shown without the mean of all that
            a replica has trained on, in their standard deviations, cut off at 10 of them.
        normalize_rewards: values have the standard deviation of the discounted return for a unit,
            which is the same as rewards divided by it.
        minibatches: equal parts of a batch, shuffled anew in each epoch, with a gradient step (and
            standardised advantages) each; 1 for the batch as it is.
        anneal_updates: the learning rate falls in equal steps, update by update, and would be zero
            after so many; None for a constant one.
        anneal_clip: whether ``clip_epsilon`` falls with the learning rate.
        clip_value: how far a value may move from that of the rollout before its error counts as if
            it had not come back (the larger of both errors); None for the plain squared error.
    """

    horizon: Annotated[int, Ge(1)] = 25
    continue_episodes: bool = False
    normalize_observations: bool = False
    normalize_rewards: bool = False
    minibatches: Annotated[int, Ge(1)] = 1
    anneal_updates: Annotated[int, Ge(1)] | None = None
    anneal_clip: bool = False
    clip_value: Annotated[float, Gt(0)] | None = None


@settings
class SolverSettings:
    """How the Solver is trained.

    Attributes:
        batch_size: levels P of an update.
        ppo: PPO's numbers.
    """

    batch_size: Annotated[int, Ge(1)] = 128
    ppo: PPOSettings = PPOSettings()


@settings
class MixtureSettings:
    """An action is a mixture of bins, from which the whole batch is drawn.

    Attributes:
        spread: standard deviation of the first policy.
    """

    kind: Literal["mixture"] = "mixture"
    spread: Annotated[float, Gt(0)] = 1.5


@settings
class ProblemSettings:
    """An action is the bin of every level, each drawn by itself (the paper's Proposer).

    Attributes:
        ratio: PPO's ratio over the P draws together, or for each draw.
        bands: frequencies of the problem index's Fourier encoding.
    """

    kind: Literal["problems"] = "problems"
    ratio: Literal["joint", "per_problem"] = "per_problem"
    bands: Annotated[int, Ge(1)] = 16


@settings
class ProposerSettings:
    """The Proposer and its meta-environment; not the paper's, but what was measured to learn.

    Attributes:
        rollouts: copies K of the Solver that are trained side by side.
        meta_episode_length: updates L of a meta-episode.
        action_repeat: updates for which an action holds; divides L.
        validation_levels: size E of the batch that the gain is measured on.
        probe_levels: number C of target levels through which the Solver is seen; at most E.
        observes: what is seen beside the probes.
        action: what an action means.
        own_action: what the Solver itself trains on: a sample of the policy or its mode.
        advance: what becomes of the Solver after a meta-episode: it trains by itself, or becomes
            the best copy, or a random one.
        advantage: against the mean of the other copies, or by a critic.
        context, hidden: widths of the network.
        ppo: PPO's numbers; the horizon is the number of actions of a meta-episode.
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
    advance: Literal["train", "best", "random"] = "train"
    advantage: Literal["leave_one_out", "gae"] = "leave_one_out"
    context: Annotated[int, Ge(1)] = 128
    hidden: Annotated[int, Ge(1)] = 128
    ppo: LearningSettings = LearningSettings(updates=3, epochs=16, gamma=1.0)


@settings
class ScheduleSettings:
    """How long a run is, and what happens how often; all in Solver updates.

    Attributes:
        updates: length of the run.
        cycle_length: updates between two improvements of the curriculum.
        evaluate_every: updates between two rows of metrics.
        checkpoint_every: updates between two checkpoints; one more follows every improvement.
        checkpoint_seconds: time after which a checkpoint is due at the next update; None for no
            such limit.
        keep_checkpoints: how many of the newest checkpoints stay.
        headline: the measurement that the run is summed up by.
        threshold: sample efficiency is the first update at which the headline reaches this.
    """

    updates: Annotated[int, Ge(1)] = 750
    cycle_length: Annotated[int, Ge(1)] = 50
    evaluate_every: Annotated[int, Ge(1)] = 10
    checkpoint_every: Annotated[int, Ge(1)] = 50
    checkpoint_seconds: Annotated[float, Gt(0)] | None = 600.0
    keep_checkpoints: Annotated[int, Ge(1)] = 2
    headline: str = "id_success"
    threshold: float = 0.8


@settings
class FilterSettings:
    """Which of more levels than are trained on are kept.

    Attributes:
        times: levels that are drawn for each that is kept.
        score: of a level; see :mod:`proposer_rl.curricula.scores`.
        source: of the score.
        rollouts: on each level, from episodes.
        temperature: of the draws among them, in units of the score.
    """

    times: Annotated[int, Ge(2)] = 4
    score: str = "learnability"
    source: Literal["exact", "episodes"] = "exact"
    rollouts: Annotated[int, Ge(1)] = 8
    temperature: Annotated[float, Gt(0)] = 0.05


@settings
class ModelSettings:
    """A model of outcomes that answers what curricula ask about performance.

    The numbers are those of :class:`~proposer_rl.curricula.outcome_model.OutcomeModel`.
    """

    labels: Literal["success", "above_worst"] = "above_worst"
    ridge: Annotated[float, Gt(0)] = 0.3
    half_life: Annotated[float, Ge(1)] = 12.0

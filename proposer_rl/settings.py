"""Validates arguments against annotated signatures, by pydantic.

:func:`checked` validates every call of a function, :func:`arguments` the values with which a
function is going to be called, such as those of a configuration. Settings are frozen dataclasses
that are validated in the same way: see :func:`settings`. ``conf/train.yaml`` lists their defaults
again (a test compares them).
"""

from __future__ import annotations

import functools
import inspect
import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from operator import index
from typing import (
    Annotated,
    Any,
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
"""A count from 1 to a million; a larger one is most likely a typing error."""
Share = Annotated[float, Interval(ge=0, le=1)]
"""A part of a whole, or a probability."""
Decay = Annotated[float, Interval(ge=0, lt=1)]
"""The share of the old in a running average."""
Positive = Annotated[float, Gt(0)]
"""A number above zero."""
NotNegative = Annotated[float, Ge(0)]
"""Zero, or a number above it."""


NAMED = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
SHOULD = "input should be "  # so begin most of pydantic's messages

BY_KIND = Discriminator("kind")
"""Tells the members of a union of settings apart, by the entry ``kind`` of each."""


class ArgumentError(ValueError):
    """An argument is not allowed; the message is one line, ``name=value: what is allowed``.

    A function that passes on the entries of one of its own arguments puts the name of that argument
    and a dot before the line; see :func:`within`.
    """

    exit_code = 2


class WholeKeyError(ArgumentError):
    """A setting of another part of the configuration is not allowed; the line has its whole key."""


def checked(function: Callable[P, T]) -> Callable[P, T]:
    """Validates the arguments of every call of a function; of a class, decorate ``__init__``.

    The annotations say what is allowed: ``step: Positive``,
    ``source: Literal["exact", "episodes"]``, ``every: Annotated[int, Interval(ge=1, le=100)]``.
    :func:`arguments` says how values are read. Defaults are not validated.

    Raises:
        ArgumentError: from the decorated function, for the first argument that is not allowed.

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

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        check_names(_parameters(function), kwargs, missing=False)
        bound = signature.bind(*args, **kwargs)
        bound.arguments.update(_checked_values(function, bound.arguments))
        return function(*bound.args, **bound.kwargs)

    return call


def signed(made: type[T]) -> type[T]:
    """Restores the signature of a class, which TorchRL's metaclass of environments hides.

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
    """Validates the values with which a function is going to be called.

    Numbers are read strictly (true and "3" are no numbers, 1.0 is no integer); infinity and NaN are
    refused. A list is allowed for a tuple, and a mapping for settings. Numbers, arrays, lists and
    mappings of other libraries are read as Python's own; see :func:`plain`. Values of types that
    pydantic does not know, such as tasks and tensors, are returned as they are.

    Args:
        function: a class or function.
        values: by name.
        given: names of arguments that the function gets from elsewhere.

    Returns:
        The values, converted to the types of the signature.

    Raises:
        ArgumentError: for the first value that is not allowed, an unknown name, or a missing one.
        NameError: if an annotation cannot be resolved.

    Example:
        >>> from typing import Literal
        >>> def learn(rate: Positive, source: Literal["exact", "episodes"] = "exact"): ...
        >>> arguments(learn, {"rate": 1})
        {'rate': 1.0}
        >>> arguments(learn, {"rat": 1})
        Traceback (most recent call last):
        ...
        proposer_rl.settings.ArgumentError: rat: unknown; there are: rate, source
    """
    known = {name: p for name, p in _parameters(function).items() if name not in given}
    check_names(known, values)
    return _checked_values(function, values)


def schema(make: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    """Returns the arguments of a function that a configuration may set: the keyword-only ones.

    If the method of a class, such as ``Curriculum.create``, takes ``**settings``, these stand for
    the keyword-only arguments of the class's constructor.
    """
    return {name: p for name, p in _parameters(make).items() if p.kind >= p.KEYWORD_ONLY}


def configured(make: Callable[..., Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Validates values against the :func:`schema` of a function, as :func:`arguments` does."""
    check_names(schema(make), values)
    return _checked_values(make, values)


@functools.cache
def _parameters(function: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    parameters = inspect.signature(function).parameters
    found = {name: p for name, p in parameters.items() if name != "self"}
    if inspect.isclass(cls := getattr(function, "__self__", None)):
        for name in [name for name, p in found.items() if p.kind is p.VAR_KEYWORD]:
            del found[name]
            found |= schema(cls.__init__)
    return found


def with_defaults(make: Callable[..., Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Returns values merged into the defaults of a function's :func:`schema`."""
    found = {}
    for name, parameter in schema(make).items():
        with suppress(TypeError):  # there is no default, or none that JSON can hold
            found[name] = json.loads(json.dumps(parameter.default))
    return {**found, **values}


def check_names(
    known: Mapping[str, inspect.Parameter], values: Mapping[str, Any], missing: bool = True
) -> None:
    """Refuses unknown names, and if asked missing ones; see :func:`arguments`."""
    named = {name: p for name, p in known.items() if p.kind in NAMED}
    if not any(p.kind is p.VAR_KEYWORD for p in known.values()):
        refuse_unknown(values, named)
    for name, parameter in named.items():
        if missing and parameter.default is parameter.empty and name not in values:
            raise ArgumentError(f"{name}: missing")


def refuse_unknown(names: Iterable[str], known: Iterable[str]) -> None:
    """Raises an ArgumentError for the first name that is not among those that are known."""
    known = [*known]
    for name in names:
        if name not in known:
            raise ArgumentError(unknown(name, known))


def unknown(name: str, known: Iterable[Any]) -> str:
    """Returns the line that refuses an unknown name and lists those that there are."""
    return f"{name}: unknown; there are: {', '.join(map(str, known)) or 'none'}"


@contextmanager
def within(name: str, *others: type[Exception], lead: str | None = None) -> Iterator[None]:
    """Puts a name and a dot before the lines of argument errors.

    Args:
        name: of an argument, or a key of the configuration, whose entries are read inside.
        others: further errors that mean bad input.
        lead: put before the messages of these; None for the name and a colon.

    Raises:
        ArgumentError: with that line.
    """
    try:
        yield
    except WholeKeyError:
        raise
    except ArgumentError as error:
        raise ArgumentError(f"{name}.{error}") from error
    except others as error:
        said = " ".join(str(error).split())
        raise ArgumentError(f"{f'{name}: ' if lead is None else lead}{said}") from error


def _checked_values(function: Callable[..., Any], values: Mapping[str, Any]) -> dict[str, Any]:
    adapters = _adapters(function)
    read = dict(values)
    for name, adapter in adapters.items():  # in the order of the signature
        if name in values and adapter is not None:
            read[name] = _read(name, values[name], adapter)
    return read


@functools.cache
def _adapters(function: Callable[..., Any]) -> dict[str, TypeAdapter[Any] | None]:
    cls = function if inspect.isclass(function) else getattr(function, "__self__", None)
    hints = get_type_hints(cls.__init__, include_extras=True) if inspect.isclass(cls) else {}
    if function is not cls:
        hints |= get_type_hints(function, include_extras=True)
    single = {inspect.Parameter.POSITIONAL_ONLY, *NAMED}
    return {
        name: _adapter(hints[name])
        for name, p in _parameters(function).items()
        if p.kind in single and name in hints
    }


def _adapter(hint: Any) -> TypeAdapter[Any] | None:
    """Returns an adapter that validates values of a type; None for a type unknown to pydantic."""
    if hint in (Any, object):
        return None
    for config in (ConfigDict(allow_inf_nan=False), None):  # a dataclass has its own
        try:
            return TypeAdapter(hint, config=config)
        except PydanticUserError:
            continue
    return None


def plain(value: Any) -> Any:
    """Returns a value of NumPy, torch, pandas or OmegaConf as Python's own.

    Scalars become Python's, arrays, series and ranges become lists, mappings become dicts, also
    within each other. Tuples and values of other types stay as they are.

    Example:
        >>> import numpy as np
        >>> plain({"rate": np.float32(0.5), "bins": np.arange(3, 6), "walls": (np.int64(1), 2)})
        {'rate': 0.5, 'bins': [3, 4, 5], 'walls': (1, 2)}
    """
    value = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(value, Mapping):
        return {plain(name): plain(entry) for name, entry in value.items()}
    if isinstance(value, tuple):
        return tuple(map(plain, value))
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [*map(plain, value)]
    return value


def shown(value: Any) -> str:
    """Returns a value as errors print it: in one line of at most 80 characters."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else f"{text[:77]}..."


def whole(name: str, value: Any, least: int | None = None) -> int:
    """Returns a whole number of any library as Python's own.

    Raises:
        ArgumentError: naming it, if it is no whole number, or smaller than the least one allowed.
    """
    allowed = "must be a whole number" + ("" if least is None else f", at least {least}")
    try:
        number = None if isinstance(value, bool) else index(value)
    except TypeError:
        number = None
    if number is None or (least is not None and number < least):
        raise ArgumentError(f"{name}={shown(plain(value))}: {allowed}")
    return number


def _read(name: str, value: Any, adapter: TypeAdapter[Any]) -> Any:
    try:
        text = json.dumps(value, default=plain)
    except (TypeError, ValueError, RecursionError):
        text = None
    try:
        # Of JSON pydantic can be strict about numbers and still take a list for a tuple.
        if text is not None:
            return adapter.validate_json(text, strict=True)
        return adapter.validate_python(value, strict=True)
    except ValidationError as error:
        raise ArgumentError(_first_line(error, name, value)) from error


def _first_line(error: ValidationError, name: str, value: Any) -> str:
    # Each member of a union has an error. The one that is deepest in the value is the most precise;
    # where several are equally deep, all their messages are told.
    all_ = [(details, *_place(details, value)) for details in error.errors()]
    within = [one for one in all_ if one[1][: len(all_[0][1])] == all_[0][1]]
    details, loc, folder = max(within, key=lambda one: len(one[1]))
    key = ".".join(map(str, [name, *loc]))
    lines = [one["msg"].removeprefix("Value error, ") for one, place, _ in within if place == loc]
    message, *others = dict.fromkeys(f"{line[0].lower()}{line[1:]}" for line in lines)
    message += "".join(f", or {other.removeprefix(SHOULD)}" for other in others)
    if details["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        return unknown(key, sorted(map(str, folder.keys() - {loc[-1]})))
    if details["type"] == "missing":
        return f"{key}: missing"
    return f"{key}={shown(details['input'])}: {message}"


def _place(details: Any, value: Any) -> tuple[list[int | str], Any]:
    """Returns the keys that lead to an error in a value, and the innermost container around it."""
    loc: list[int | str] = []
    folder = inner = value
    for part in details["loc"]:
        try:
            folder, inner = inner, inner[part]
        except (LookupError, TypeError):
            if details["type"] != "missing":  # this part is no key: it names a member of a union
                continue
        loc.append(part)
    return loc, folder


@dataclass_transform(frozen_default=True, kw_only_default=True)
def settings(cls: type[T]) -> type[T]:
    """Makes a frozen, keyword-only dataclass whose constructor is :func:`checked`.

    Ranges stand in the annotations (``Annotated[int, Ge(1)]``).
    """
    decorated = dataclass(frozen=True, kw_only=True)(cls)
    decorated.__pydantic_config__ = {"extra": "forbid", "allow_inf_nan": False}  # type: ignore[attr-defined]
    decorated.__init__ = checked(decorated.__init__)  # type: ignore[method-assign]
    return decorated

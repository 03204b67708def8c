"""The settings of a task that is an environment of Gymnasium."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, NamedTuple

from annotated_types import Ge, Gt, Len

from proposer_rl.settings import settings
from proposer_rl.tasks.gymnasium.answers import UnfitEnvironmentError, entries, flag
from proposer_rl.tasks.ranges import RangeSettings

# The dotted name of a function or class, or that with its further arguments by name.
WrapperSettings = str | Annotated[dict[str, dict[str, Any]], Len(1, 1)]
Widths = list[Annotated[int, Ge(1)]]


@settings
class ParameterSettings(RangeSettings):
    """A number of the environment that differs between levels.

    Attributes:
        set: how it gets into the environment, before each reset: as an attribute, as an argument
            of the constructor (the environment is then built anew where it changes), as an option
            of the reset, or by a function that is called with the environment and the number.
        name: of the attribute (dots lead to parts of the environment, numbers to elements),
            argument, option or function (which must be given), or of several that all get the
            value; None for the parameter's own name.
    """

    set: Literal["attribute", "argument", "option", "call"] = "attribute"
    name: str | Annotated[list[str], Len(1)] | None = None

    def names(self, own: str) -> list[str]:
        """Where the value of the parameter, whose own name this is, goes."""
        name = own if self.name is None else self.name
        return [name] if isinstance(name, str) else name


class Step(NamedTuple):
    """A step, mostly the last one of an episode.

    Attributes:
        terminated: whether the environment ended it.
        truncated: whether it was cut off.
        in_time: whether the time limit had not been reached.
        returns: the sum of the episode's rewards.
        info: what the environment told.
    """

    terminated: bool
    truncated: bool
    in_time: bool
    returns: float
    info: Mapping[str, Any]


@settings
class SuccessSettings:
    """When an episode counts as a success, which is known at its end; it is called to know it.

    Attributes:
        kind: ``return``: it has at least the return ``least``; ``survived``: the time limit ended
            it, and nothing else; ``terminated``: the environment did, before; ``info``: an entry of
            the last step's info is true.
        least: the return.
        key: the entry's name; dots lead to entries of entries.
        optional: whether the entry is told only where the episode is a success.
        once: whether the entry may be true in any step, so that what is reached and lost again is a
            success, too.
    """

    kind: Literal["return", "survived", "terminated", "info"]
    least: float | None = None
    key: str | None = None
    optional: bool = False
    once: bool = False

    def check(self) -> None:
        """Refuse a kind that lacks what it needs, or has more.

        Raises:
            ValueError: naming the key.
        """
        needed = {"return": "least", "info": "key"}.get(self.kind)
        for name in ("least", "key"):
            given = getattr(self, name) is not None
            if given != (name == needed):
                verb = "has no effect" if given else "missing"
                raise ValueError(f"success.{name}: {verb} with success.kind={self.kind}")
        for name in ("optional", "once"):
            if getattr(self, name) and self.kind != "info":
                raise ValueError(f"success.{name}: has no effect with success.kind={self.kind}")

    def __call__(self, step: Step) -> bool:
        """Whether an episode with this last step, or with ``once`` any such step, is a success.

        Raises:
            UnfitEnvironmentError: if its info says it in something else than a truth value.
        """
        if self.kind == "return":
            return step.returns >= (self.least or 0.0)
        if self.kind == "survived":
            return not step.terminated and not step.in_time
        if self.kind == "terminated":
            return step.terminated
        value = self._entry(step.info)
        return value is not None and flag(value, f"success.key={self.key}: the entry of the info")

    def check_told(self, info: Mapping[str, Any]) -> None:
        """Refuse the last info of an episode that does not say whether that was a success.

        Raises:
            UnfitEnvironmentError: naming the key and the entries that there are.
        """
        if self.kind == "info" and not self.optional and self._entry(info) is None:
            there = ", ".join(name for name, _ in entries(info))
            raise UnfitEnvironmentError(
                f"success.key={self.key}: the last info of an episode has no such entry; it has: "
                f"{there or 'none'}; where only episodes that succeed have it, set "
                "success.optional=true"
            )

    def _entry(self, info: Mapping[str, Any]) -> Any:
        """The info's entry; None where it is absent."""
        return dict(entries(info)).get(self.key or "")


@settings
class NetworkSettings:
    """The Solver's network: an MLP of numbers, a CNN of images.

    Attributes:
        hidden: widths of the hidden layers, of the policy and of the critic.
        channels: of the convolutions before them, for images; None for what their size asks for.
        scale: observations are multiplied with it; None for 1, and 1/255 of bytes.
        image: order of an image's axes; None for what its shape tells.
        memory: width of an LSTM between what is seen and the heads, which then have one hidden
            layer, of the last width; None for no memory.
    """

    hidden: Annotated[Widths, Len(1)]
    channels: Widths | None = None
    scale: Annotated[float, Gt(0)] | None = None
    image: Literal["HWC", "CHW"] | None = None
    memory: Annotated[int, Ge(1)] | None = None


@settings
class EvaluationSettings:
    """How Solvers are measured: by episodes.

    Attributes:
        levels: of each distribution, the same in every run.
        episodes: played on each level, with drawn actions: the most probable ones make the same
            episode every time, since each begins with the level's own seed.
        actions: drawn from the policy, or the most probable ones.
        seed: of the levels and of the actions.
    """

    levels: Annotated[int, Ge(1)]
    episodes: Annotated[int, Ge(1)] = 1
    actions: Literal["sampled", "most_probable"] = "sampled"
    seed: Annotated[int, Ge(0)] = 0

    def __post_init__(self) -> None:
        if self.episodes > 1 and self.actions == "most_probable":
            raise ValueError(
                f"episodes={self.episodes}: with actions=most_probable all episodes on a level are "
                "the same; leave episodes=1"
            )

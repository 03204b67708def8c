"""The settings of a task that is an environment of Gymnasium."""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Ge, Gt, Len

from proposer_rl.settings import settings
from proposer_rl.tasks.parameters import Number

Widths = list[Annotated[int, Ge(1)]]


@settings
class ParameterSettings:
    """A number of the environment that differs between levels.

    Either ``values``, each of which is a bin, or a range from ``low`` to ``high`` in ``bins`` equal
    parts, within which it is drawn uniformly.

    Attributes:
        set: how it gets into the environment, before each reset: as an attribute, as an argument
            of the constructor (the environment is then built anew where it changes), as an option
            of the reset, or by a function that is called with the environment and the number.
        name: of the attribute (dots lead to parts of the environment), argument, option or
            function (which must be given); None for the parameter's own name.
        values: rising; whole numbers, if all are.
        low, high, bins: of a range.
        target: what is to be mastered: a number; of ``values`` also several, equally likely; of a
            range also [from, to].
    """

    set: Literal["attribute", "argument", "option", "call"] = "attribute"
    name: str | None = None
    values: Annotated[list[Number], Len(1)] | None = None
    low: float | None = None
    high: float | None = None
    bins: Annotated[int, Ge(1)] | None = None
    target: Number | Annotated[list[Number], Len(1)]


@settings
class SuccessSettings:
    """When an episode counts as a success, which is known at its end.

    Attributes:
        kind: ``return``: it has at least the return ``least``; ``survived``: the time limit ended
            it; ``terminated``: the environment did, before; ``info``: an entry of the last step's
            info is true.
        least: the return.
        key: the entry's name.
    """

    kind: Literal["return", "survived", "terminated", "info"]
    least: float | None = None
    key: str | None = None


@settings
class NetworkSettings:
    """The Solver's network: an MLP of numbers, a CNN of images.

    Attributes:
        hidden: widths of the hidden layers, of the policy and of the critic.
        channels: of the convolutions before them, for images [H, W, C].
        scale: observations are multiplied with it; None for 1, and 1/255 of bytes.
    """

    hidden: Widths
    channels: Widths
    scale: Annotated[float, Gt(0)] | None = None


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

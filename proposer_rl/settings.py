"""Groups of numbers that a configuration sets: plain frozen dataclasses with checked ranges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

from typing_extensions import dataclass_transform

T = TypeVar("T")


@dataclass_transform(frozen_default=True, kw_only_default=True)
def settings(cls: type[T]) -> type[T]:
    """A frozen, keyword-only dataclass.

    Ranges stand in the annotations (``Annotated[int, Ge(1)]``). Library code constructs the class
    like any dataclass; the command line validates its values against the annotations first, and
    refuses keys that the class does not have, and infinite numbers.
    """
    decorated = dataclass(frozen=True, kw_only=True)(cls)
    decorated.__pydantic_config__ = {"extra": "forbid", "allow_inf_nan": False}  # type: ignore[attr-defined]
    return decorated

"""Reads a run's records: validates them, and returns their numbers, texts and pictures."""

from __future__ import annotations

import base64
import io
import json
import math
import re
from collections.abc import Hashable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from pydantic import BaseModel, FiniteFloat, TypeAdapter, ValidationError

from proposer_rl.runs.folder import is_rate

ACRONYMS = ("id", "ood")  # in- and out-of-distribution
LARGEST = 1e100  # greater numbers are not measurements, and overflow when they are drawn
LONGEST_TEXT = 400  # characters that are shown in a line

Column = NDArray[np.float64]
Record = Mapping[str, Any]
T = TypeVar("T")
_adapter = cache(TypeAdapter)  # slower to make than to use
COLOURS = 64  # of a picture: enough for drawings, in a third of the bytes
WIDTH = 150  # of a picture of text, in pixels


class LevelRecord(BaseModel):
    """A level as its task recorded it: a PNG in base64, lines of text, or both."""

    picture: str | None = None
    text: list[str] = []


class SampleRecord(BaseModel):
    """Levels that a seed trained on."""

    updates: int
    seed: int
    levels: list[LevelRecord]


class TaskFacts(BaseModel):
    """A run's description of its task, for reports.

    Attributes:
        title: such as ``6×6 mazes``.
        levels: the word for levels, plural.
        distributions: names of the distributions that were measured on.
        space: that the curriculum chooses from: the values along each axis, numbers or texts, by
            name.
        about: further facts, by label.
        measured: everything that must be equal for two runs to be comparable.
        key: explains pictures of levels.
        text_key: explains levels that are drawn in characters.
        exact: whether measurements draw nothing at random; None if that is not known.
    """

    title: str
    levels: str = "levels"
    distributions: list[str]
    space: dict[str, list[FiniteFloat | str]] = {}
    about: dict[str, str] = {}
    measured: Any
    key: str = ""
    text_key: str = ""
    exact: bool | None = None


def checked(kind: type[T], value: Any, where: str) -> T:
    """Validates a value from a file or a request; bytes are read as JSON.

    Raises:
        ValueError: naming the place of the first error.
    """
    adapter = _adapter(cast(Hashable, kind))
    check = adapter.validate_json if isinstance(value, bytes) else adapter.validate_python
    try:
        return cast(T, check(value, strict=True))
    except ValidationError as error:
        first = error.errors(include_input=False, include_url=False)[0]
        place = ".".join(map(str, first["loc"]))
        raise ValueError(": ".join(filter(None, [where, place, first["msg"]]))) from error


def small_json(path: Path) -> Any:
    """Returns the content of a run's small JSON file; None if it cannot be read."""
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return None


def printable(text: str) -> str:
    """Returns a text as one line without control characters."""
    return "".join(c if c.isprintable() else "?" for c in " ".join(text.split()))


def natural(text: str) -> list[tuple[float, str]]:
    """Returns a key that sorts texts by the numbers in them: 0, 1, 10 and 11, not 0, 1, 10, 2.

    Example:
        >>> sorted(["10_plr", "2_plr", "1_plr"], key=natural)
        ['1_plr', '2_plr', '10_plr']
    """
    parts = re.split(r"(\d+)", text, flags=re.ASCII)
    return [(float(part), part) if i % 2 else (-1.0, part) for i, part in enumerate(parts)]


def encoded(text: str) -> bytes:
    """Returns a text as UTF-8, with ``?`` for what has no encoding, such as half of a pair."""
    return text.encode("utf-8", "replace")


def anywhere(text: str) -> str:
    """Returns text with absolute paths cut to their last part, to be free of the machine."""
    return re.sub(r"(?<![\w./])/(?:[\w.\-]+/)+", "", text)


def number(value: Any) -> float:
    """Returns a recorded number, or the mean of a list of numbers; NaN for other values."""
    if isinstance(value, list):
        found = numbers(value)
        return math.nan if found is None else float(found.mean())
    if isinstance(value, bool) or not isinstance(value, int | float):
        return math.nan
    return float(value) if abs(value) < LARGEST else math.nan


def numbers(value: Any) -> Column | None:
    """Returns a list of finite numbers as an array [n]; None for other values."""
    if not isinstance(value, list) or not value or any(isinstance(one, list) for one in value):
        return None
    found = np.array([number(one) for one in value])
    return found if np.isfinite(found).all() else None


def flat(record: Record) -> dict[str, float]:
    """Returns the finite numbers of a record by name, of a list of numbers its maximum and mean.

    The entry ``shares``, shares of a batch by the names of its parts, has a number for each part;
    those of several students are averaged.
    """
    found: dict[str, float] = {}
    for name, value in record.items():
        if name == "shares" and isinstance(value, Mapping):
            found |= {f"{name}/{part}": number(own) for part, own in value.items()}
        elif (several := numbers(value)) is not None:
            found |= {f"{name}_max": float(several.max()), f"{name}_mean": float(several.mean())}
        else:
            found[name] = number(value)
    return {name: value for name, value in found.items() if not math.isnan(value)}


def words(name: str) -> str:
    """Returns a column's name in words, such as "ID success" for ``id_success``."""
    first, _, rest = name.partition("_")
    first = first.upper() if first in ACRONYMS else first
    return f"{first} {rest.replace('_', ' ')}".strip()


def level_text(name: str, value: float) -> str:
    """Returns a column's value as text: 80% for a success, 0.8 for other columns."""
    return f"{100 * value:g}%" if is_rate(name) else f"{value:g}"


def png(picture: NDArray[np.uint8]) -> str:
    """Returns a picture uint8 [H, W, 3] as PNG in base64, in its most frequent colours."""
    image = Image.fromarray(picture).quantize(COLOURS, dither=Image.Dither.NONE)
    file = io.BytesIO()
    image.save(file, "PNG", optimize=True)
    return base64.b64encode(file.getvalue()).decode()


def pixels(text: str) -> NDArray[np.uint8]:
    """Returns the picture uint8 [H, W, 3] in a text of :func:`png`."""
    with Image.open(io.BytesIO(base64.b64decode(text)), formats=["PNG"]) as image:
        return np.asarray(image.convert("RGB"))


def written(lines: Sequence[str]) -> NDArray[np.uint8]:
    """Returns lines of text as a picture, uint8 [H, W, 3]."""
    image = Image.new("RGB", (WIDTH, 8 + 14 * len(lines)), (250, 250, 250))
    ImageDraw.Draw(image).multiline_text((4, 4), "\n".join(lines), (45, 45, 45))
    return np.asarray(image)

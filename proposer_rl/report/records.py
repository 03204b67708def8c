"""Numbers, texts and pictures of a run's records. They may come from anybody and be anything."""

from __future__ import annotations

import base64
import io
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

LONGEST_NAME, LONGEST_TEXT = 80, 400  # characters
MOST_AXES, LONGEST_AXIS = 8, 256
TEXT_LINES, TEXT_COLUMNS = 64, 200  # of a level drawn in characters
PICTURE_BYTES = PICTURE_PIXELS = 2**20
LARGEST = 1e100  # what is greater is no measurement, and overflows when it is drawn

# Total gains of copies, by their name in the records of cycles; the first that is there is shown.
GAINS = {"log_success_gain": "log success", "return_gain": "return"}
# What of a cycle's record is not a number of the curriculum's own.
PLACE = {"cycle", "updates", "seed", "curriculum_frames", "evaluations", "histogram"}

Column = NDArray[np.float64]
Record = Mapping[str, Any]


@dataclass(frozen=True)
class TaskFacts:
    """What a run says of its task, for a reader.

    Attributes:
        title: what it is, as ``6×6 mazes``.
        levels: what a level is called, plural.
        distributions: names of what was measured on.
        axes: of the space of levels that is chosen from: the values along each, by its name.
        about: further facts, by their label.
        measured: all that must be equal for two runs to be comparable.
        samples: records of levels of each distribution.
        key, text_key: what is to be seen in pictures, and in levels drawn in characters.
    """

    title: str
    levels: str
    distributions: tuple[str, ...]
    axes: Mapping[str, Column]
    about: Mapping[str, str]
    measured: Any
    samples: Mapping[str, Sequence[Record]]
    key: str
    text_key: str


def read_task(value: Any) -> TaskFacts:
    """The facts of a task from ``run.json``.

    Raises:
        KeyError: if title, distributions or measured is missing.
        ValueError: if an entry is not what it should be.
    """
    task = _mapping(value, "task")
    space, about, samples = (
        _mapping(task.get(key) or {}, f"task.{key}") for key in ("space", "about", "samples")
    )
    axes = {plain(name, "run.json: task.space"): numbers(axis) for name, axis in space.items()}
    kept = {name: axis for name, axis in axes.items() if axis is not None}
    if len(kept) < len(axes) or not all(len(axis) <= LONGEST_AXIS for axis in kept.values()):
        raise ValueError(f"run.json: an axis of task.space is no list of {LONGEST_AXIS} values")
    if len(axes) > MOST_AXES:
        raise ValueError(f"run.json: task.space has more than {MOST_AXES} axes")
    names = task["distributions"]
    if not isinstance(names, list) or not names:
        raise ValueError("run.json: task.distributions is no list of names")

    def text(key: str, value: Any, longest: int = LONGEST_NAME) -> str:
        return plain(value, f"run.json: task.{key}", longest)

    return TaskFacts(
        title=text("title", task["title"]),
        levels=text("levels", task.get("levels", "levels")),
        distributions=tuple(text("distributions", name) for name in names),
        axes=kept,
        about={
            text("about", key): text(f"about.{key}", line, LONGEST_TEXT)
            for key, line in about.items()
        },
        measured=task["measured"],
        samples={name: checked_levels(levels, "run.json") for name, levels in samples.items()},
        key=text("key", task.get("key") or " ", LONGEST_TEXT).strip(),
        text_key=text("text_key", task.get("text_key") or " ", LONGEST_TEXT).strip(),
    )


def plain(value: Any, where: str, longest: int = LONGEST_NAME) -> str:
    """A text of one line.

    Raises:
        ValueError: if it is none, or too long; naming ``where``.
    """
    if isinstance(value, str) and 0 < len(value) <= longest and value.isprintable():
        return value
    raise ValueError(f"{where} is no text of one line and at most {longest} characters")


def printable(text: str) -> str:
    """A text as one line that can do nothing to a terminal."""
    return "".join(c if c.isprintable() else "?" for c in " ".join(text.split()))


def checked_levels(records: Any, where: str) -> list[Record]:
    """Records of levels: a picture and lines of text, each optional and bounded.

    Raises:
        ValueError: if they are not so; naming ``where``.
    """
    if not isinstance(records, list) or not all(isinstance(record, dict) for record in records):
        raise ValueError(f"{where}: levels are no list of objects")
    for record in records:
        encoded, lines = record.get("picture", ""), record.get("text", [])
        if not isinstance(encoded, str) or len(encoded) > PICTURE_BYTES * 4 // 3 + 4:
            raise ValueError(f"{where}: a picture is no PNG of at most {PICTURE_BYTES} bytes")
        if not isinstance(lines, list) or len(lines) > TEXT_LINES:
            raise ValueError(f"{where}: a level's text is no list of {TEXT_LINES} lines")
        for line in lines:
            plain(line, f"{where}: a line of a level", TEXT_COLUMNS)
    return records


def picture(record: Record) -> NDArray[np.uint8] | None:
    """A level's picture, uint8 [H, W, 3]; None without one that can be shown."""
    try:
        content = base64.b64decode(record["picture"], validate=True)
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(content), formats=["PNG"]) as image:
                if not 0 < image.width * image.height <= PICTURE_PIXELS:
                    return None
                image.verify()
            # Verified, a file must be opened again.
            with Image.open(io.BytesIO(content), formats=["PNG"]) as image:
                return np.asarray(image.convert("RGB"))
    except Exception:  # whatever a decoder makes of foreign bytes, it is no picture
        return None


def number(value: Any) -> float:
    """A recorded number, of a list of numbers the mean; NaN where it is neither."""
    if isinstance(value, list):
        found = numbers(value)
        return math.nan if found is None else float(found.mean())
    if isinstance(value, bool) or not isinstance(value, int | float):
        return math.nan
    return float(value) if abs(value) < LARGEST else math.nan


def numbers(value: Any) -> Column | None:
    """A list of finite numbers; None where it is none."""
    if not isinstance(value, list) or not value or any(isinstance(one, list) for one in value):
        return None
    found = np.array([number(one) for one in value])
    return found if np.isfinite(found).all() else None


def is_rate(name: str) -> bool:
    """Whether a column holds shares from 0 to 1, as success is."""
    return "success" in name.split("_")


def words(name: str) -> str:
    """A column in words: ``id_success`` is ID success."""
    first, _, rest = name.partition("_")
    first = first.upper() if len(first) <= 3 else first
    return f"{first} {rest.replace('_', ' ')}".strip()


def level_text(name: str, value: float) -> str:
    """A value of a column as a reader wants it: 80% of a success, 0.8 of anything else."""
    return f"{value:.0%}" if is_rate(name) else f"{value:g}"


def _mapping(value: Any, key: str) -> Mapping[str, Any]:
    if isinstance(value, dict):
        return value
    raise ValueError(f"run.json: {key} is no object")

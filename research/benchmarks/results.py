"""What a benchmark is asked and what it answers: plain data that goes through JSON and back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from statistics import median
from typing import Any, Literal

from pydantic import TypeAdapter

Size = Literal["tiny", "normal", "full"]
Unit = Literal["x", "%", "/s", "GiB", "ms", "s"]


@dataclass(frozen=True)
class Options:
    """What every benchmark is told.

    Attributes:
        repeats: rounds of interleaved timings.
        precision: of the Solver's network where a benchmark does not compare both; ``auto`` for the
            faster one.
        device: where the Solver and its levels live.
        size: ``tiny`` to see that everything runs, ``full`` for the paper's values throughout.
        jaxued: an interpreter that has jaxued, to be measured beside our view maze; None for none.
        syllabus: an interpreter that has Syllabus, whose curricula are timed; None for none.
        runs: folders of runs, whose methods are measured in place of those that one knows.
        seeds: of what is trained in Gymnasium's environments.
        environments: of these, by name; none for all.
        rows: the table of what was trained there before; empty for none.
    """

    repeats: int = 5
    precision: str = "auto"
    device: str = "cpu"
    size: Size = "normal"
    jaxued: str | None = None
    syllabus: str | None = None
    runs: Sequence[str] = ()
    seeds: Sequence[int] = (100, 101, 102, 103, 104)
    environments: Sequence[str] = ()
    rows: str = ""

    @property
    def few(self) -> int:
        """Rounds of a benchmark of which one takes many seconds."""
        return (self.repeats + 1) // 2

    @property
    def tiny(self) -> bool:
        """Whether only the code is tried, not the machine."""
        return self.size == "tiny"


@dataclass(frozen=True)
class Spread:
    """Median and range of one number over the rounds."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: list[float]) -> Spread:
        """The spread of at least one number."""
        return cls(median(values), min(values), max(values))


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        what: what was measured.
        against: what it was measured against, or a remark on an absolute number.
        value: the measurement; shares are fractions here, times are seconds.
        unit: for showing the value and the target; of times both are in seconds.
        target: what is to be reached; None for information only.
        at_most: whether the target is an upper bound.
        samples: the timings behind it, in seconds, by name and in the order of the rounds.
    """

    what: str
    against: str
    value: Spread
    unit: Unit
    target: float | None = None
    at_most: bool = False
    samples: dict[str, list[float]] = field(default_factory=dict)

    @property
    def reached(self) -> bool | None:
        """Whether the median meets the target; None without one."""
        if self.target is None:
            return None
        if self.at_most:
            return self.value.median <= self.target
        return self.value.median >= self.target


@dataclass(frozen=True)
class Table:
    """Details behind the rows: a header and lines of as many cells."""

    title: str
    header: list[str]
    lines: list[list[str]]


@dataclass
class Result:
    """All that one benchmark found."""

    rows: list[Row]
    tables: list[Table] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """Plain dicts, each row with whether it reached its target."""
        content = asdict(self)
        for entry, row in zip(content["rows"], self.rows, strict=True):
            entry["reached"] = row.reached
        return content

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> Result:
        """What :meth:`to_json` gave; further entries are ignored."""
        result: Result = TypeAdapter(cls).validate_python(content)
        return result

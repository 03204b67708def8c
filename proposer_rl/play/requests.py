"""What the page may ask for: checked before anything is done with it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

LARGEST_SIDE = 64  # cells of a drawing
MOST_STEPS = 5000  # of an episode
LARGEST_BODY = 2**18  # bytes of a request
LARGEST_SEED = 2**31 - 1

Number = Annotated[int, Field(ge=0, le=LARGEST_SEED)]
Name = Annotated[str, Field(max_length=80)]
Row = Annotated[str, Field(min_length=1, max_length=LARGEST_SIDE)]
Rows = Annotated[list[Row], Field(min_length=1, max_length=LARGEST_SIDE)]


class Question(BaseModel):
    """JSON with these keys and no others, each of its own type."""

    model_config = ConfigDict(extra="forbid", strict=True)


class Examine(Question):
    """What does a Solver do on this drawing?

    Attributes:
        checkpoint: its number, one of those that the run has.
        solver: the Solver's number among those that were trained side by side.
        rows: the drawing.
        max_steps: step limit; None for the task's choice.
    """

    checkpoint: Number
    solver: Number
    rows: Rows
    max_steps: Annotated[int, Field(ge=1, le=MOST_STEPS)] | None = None


class Drawn(Question):
    """Levels drawn from a distribution, and how a Solver does there."""

    source: Literal["distribution"]
    name: Name
    seed: Number
    checkpoint: Number
    solver: Number


class OfSet(Question):
    """The levels of a shipped set."""

    source: Literal["set"]
    name: Name


class OfCurriculum(Question):
    """Levels that were trained on: a row of the run's ``curriculum.jsonl``."""

    source: Literal["curriculum"]
    row: Number


class OfFile(Question):
    """The levels in the text of a file."""

    source: Literal["file"]
    text: Annotated[str, Field(max_length=LARGEST_BODY)]


class Write(Question):
    """The text of a file with this drawing."""

    name: Name
    rows: Rows


Source = Annotated[Drawn | OfSet | OfCurriculum | OfFile, Field(discriminator="source")]

"""What a run is doing at the moment and how long it will take, in a small file of its folder."""

from __future__ import annotations

import json
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from proposer_rl.runs.folder import write_atomically

FILE = "progress.json"
EVERY = 1.0  # seconds between two writes


class Activity(NamedTuple):
    """What a run is doing.

    Attributes:
        doing: in words; empty between two phases.
        done, of: how many parts of it are done; 0 of 0 where there are none.
        seconds_left: of the whole run; None where nothing is known of what is going on.
        at_least: whether there is more to come of which nothing is known yet.
    """

    doing: str
    done: int
    of: int
    seconds_left: float | None
    at_least: bool

    def text(self) -> str:
        """As in ``training the replicas 37/100, about 5 h left``."""
        parts = [f"{self.doing} {self.done}/{self.of}" if self.of else self.doing]
        if self.seconds_left is not None:
            about = "at least" if self.at_least else "about"
            parts.append(f"{about} {duration(self.seconds_left)} left")
        return ", ".join(filter(None, parts))


def duration(seconds: float) -> str:
    """Seconds in the unit that reads best."""
    for unit, size in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


class Status:
    """Times the phases of a run, such as an update, and from them the rest of it.

    What is left takes, phase by phase, as many units as are left times the mean of those so far. A
    phase of which no unit has ended counts by the share of the first one that is done; of which
    none has begun, not at all: then it takes at least that long.

    Args:
        parts: number of parts of a unit that reports them by :meth:`tick`.
        clock: seconds.
    """

    def __init__(self, parts: int = 1, clock: Callable[[], float] = time.monotonic) -> None:
        self._parts = parts
        self._clock = clock
        self._left: dict[str, int] = {}
        self._spent: defaultdict[str, float] = defaultdict(float)
        self._ended: defaultdict[str, int] = defaultdict(int)
        self._phase = self._doing = ""
        self._began, self._ticks = 0.0, 0
        self._folder: Path | None = None
        self._told = -EVERY
        self._show: Callable[[], None] = lambda: None

    @contextmanager
    def of_run(self, folder: Path, show: Callable[[], None]) -> Iterator[None]:
        """While a run goes on, report it in its folder, and call ``show`` as often."""
        self._folder, self._show = folder, show
        try:
            yield
        finally:
            self._folder = None
            # A run that is over does nothing, however it ended; and why it did is to be told, not
            # that a file of no worth stays.
            with suppress(OSError):
                (folder / FILE).unlink()

    def plan(self, left: Mapping[str, int]) -> None:
        """Say how many units of each phase are left."""
        self._left = dict(left)

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """While a unit of a phase goes on."""
        self._phase = self._doing = name
        self._began, self._ticks = self._clock(), 0
        self._tell()
        yield
        self._spent[name] += self._clock() - self._began
        self._ended[name] += 1
        self._left[name] = max(self._left.get(name, 0) - 1, 0)
        self._phase = self._doing = ""

    def tick(self, doing: str, done: int) -> None:
        """Say how many parts of the present unit are done, in which the run does that."""
        self._doing = doing
        self._ticks = done
        self._tell()

    def activity(self) -> Activity:
        """What the run is doing, and how long it will take."""
        seconds, all_known = self.remaining()
        told = seconds and (not self._phase or self._unit(self._phase) is not None)
        return Activity(
            self._doing,
            min(self._ticks, self._parts),
            self._parts if self._ticks else 0,
            round(seconds, 1) if told else None,
            not all_known,
        )

    def remaining(self) -> tuple[float, bool]:
        """Seconds until the end, and whether these are all: False for "at least"."""
        seconds, all_known = 0.0, True
        for name, left in self._left.items():
            unit = self._unit(name)
            if left and unit is None:
                all_known = False
            elif unit is not None:
                spent = self._clock() - self._began if name == self._phase else 0.0
                seconds += max(unit * left - spent, 0.0)
        return seconds, all_known

    def _unit(self, name: str) -> float | None:
        """Seconds of a unit; None where nothing is known of it."""
        if self._ended[name]:
            return self._spent[name] / self._ended[name]
        if name == self._phase and self._ticks:
            return (self._clock() - self._began) * max(self._parts / self._ticks, 1.0)
        return None

    def _tell(self) -> None:
        now = self._clock()
        if self._folder is None or now - self._told < EVERY:
            return
        self._told = now
        content = json.dumps(self.activity()._asdict()).encode()
        write_atomically(self._folder / FILE, content, durably=False)
        self._show()

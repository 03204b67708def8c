"""What a run is doing at the moment, in a small file of its folder."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from proposer_rl.runs.folder import write_atomically

FILE = "progress.json"
EVERY = 1.0  # seconds between two writes


class Status:
    """Says what a run is doing.

    Args:
        parts: number of parts of the work that is told in parts.
        clock: seconds.
    """

    def __init__(self, parts: int = 1, clock: Callable[[], float] = time.monotonic) -> None:
        self.doing = ""
        self._parts = parts
        self._clock = clock
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

    def tell(self, doing: str, part: int = 0) -> None:
        """Say what the run does, and how many parts of it are done; 0 where it has none."""
        self.doing = f"{doing} {min(part, self._parts)}/{self._parts}" if part else doing
        now = self._clock()
        if self._folder is None or now - self._told < EVERY:
            return
        self._told = now
        content = json.dumps({"doing": self.doing}).encode()
        write_atomically(self._folder / FILE, content, durably=False)
        self._show()

"""The committed results, which many tests read: each study once in a process."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

from proposer_rl.report import studies

RESULTS = Path(__file__).parents[1] / "results"
needs_results = pytest.mark.skipif(not RESULTS.is_dir(), reason="source archives have no results/")


def remember() -> None:
    """Let this process work so."""
    read, once = studies.read_run, cache(studies.read_run)

    def read_once(folder: Path) -> list[studies.Run]:
        """The runs of a folder; tests write the others, and may do so again."""
        path = folder.resolve()
        return [*once(path)] if path.is_relative_to(RESULTS) else read(folder)

    studies.read_run = read_once

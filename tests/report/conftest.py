"""What tests of reports share."""

from __future__ import annotations

import pytest

from proposer_rl.report import build


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports without figures, which take seconds: it is the numbers that are tested."""
    monkeypatch.setattr(build, "DRAWINGS", [])

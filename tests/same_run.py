"""Runs that are stopped where a test chooses, and what two runs' folders have in common."""

from __future__ import annotations

from pathlib import Path
from signal import SIGTERM
from typing import Any

import torch

from proposer_rl.runs.checkpoint import load_latest
from proposer_rl.runs.folder import read_csv
from proposer_rl.runs.process import Interrupted, StopSignals


class StopAt(StopSignals):
    """A signal that comes at the n-th safe point."""

    def __init__(self, points: int) -> None:
        super().__init__()
        self.left = points

    @property
    def pending(self) -> bool:
        return self.left == 1

    def deliver(self) -> None:
        self.left -= 1
        if self.left == 0:
            raise Interrupted(SIGTERM)


def tables(folder: Path) -> dict[str, Any]:
    """All that a run measured, without wall-clock times."""
    found: dict[str, Any] = {}
    for path in sorted(folder.glob("*.csv")):
        # repr tells -0.0 from 0.0 and nan from nothing: the same text is the same bytes.
        found[path.name] = [repr({**row, "seconds": 0}) for row in read_csv(path)]
    for path in sorted(folder.glob("*.jsonl")):
        found[path.name] = path.read_bytes()
    return found


def trained(folder: Path) -> dict[str, torch.Tensor]:
    """Every tensor of the newest checkpoint, by its place: weights and Adam's state of all."""
    latest = load_latest(folder / "checkpoints")
    assert latest is not None
    state = latest[1]
    return dict(_leaves({"solver": state["solver"], "curricula": state["curricula"]}))


def assert_same_run(one: Path, other: Path) -> None:
    assert tables(one) == tables(other)
    first, second = trained(one), trained(other)
    assert first.keys() == second.keys()
    assert all(_bits(first[name]) == _bits(second[name]) for name in first)


def _leaves(value: Any, place: str = "") -> list[tuple[str, torch.Tensor]]:
    if isinstance(value, dict):
        return [leaf for key, inner in value.items() for leaf in _leaves(inner, f"{place}/{key}")]
    return [(place, value)] if isinstance(value, torch.Tensor) else []


def _bits(tensor: torch.Tensor) -> bytes:
    return tensor.contiguous().numpy().tobytes()

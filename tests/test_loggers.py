from __future__ import annotations

import sys
from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from proposer_rl.cli.config import ConfigError, LoggerSettings
from proposer_rl.cli.loggers import make_log


def test_the_runs_folder_is_enough_for_csv(tmp_path: Path) -> None:
    assert make_log(LoggerSettings(type="csv"), tmp_path, "run") is None


def test_rows_go_to_tensorboard(tmp_path: Path) -> None:
    log = make_log(LoggerSettings(type="tensorboard"), tmp_path, "run")
    assert log is not None
    log("metrics", {"id_success": 0.25, "frames": 100}, 10)
    log("metrics", {"id_success": 0.5, "frames": 200}, 20)
    (folder,) = {file.parent for file in tmp_path.rglob("events.out.*")}
    events = EventAccumulator(str(folder)).Reload()
    found = [(event.step, event.value) for event in events.Scalars("metrics/id_success")]
    assert found == [(10, 0.25), (20, 0.5)]


def test_a_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(ConfigError, match=r"logger=wandb.*pip install 'proposer_rl\[wandb\]'"):
        make_log(LoggerSettings(type="wandb", mode="disabled"), tmp_path, "run")

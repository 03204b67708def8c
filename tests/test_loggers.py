from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from proposer_rl.cli.config import ConfigError, LoggerSettings
from proposer_rl.cli.loggers import make_log, require_logger
from proposer_rl.mazes import Level, draw_grid
from tests.report.folders import LEVEL, cycle, write_run


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


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("proposer_rl.cli.loggers.find_spec", {"tensorboard": object()}.get)
    require_logger(LoggerSettings(type="csv"))
    require_logger(LoggerSettings(type="tensorboard"))
    with pytest.raises(ConfigError, match=r"logger=wandb.*pip install 'proposer_rl\[wandb\]'"):
        require_logger(LoggerSettings(type="wandb", mode="disabled"))


def test_levels_and_proposals_go_to_tensorboard_as_images(tmp_path: Path) -> None:
    cycles = [cycle(0, [0.25, -0.5], [[6, 0, 0], [0, 0, 0]])]
    folder = write_run(tmp_path / "run", "perf_gain", cycles=cycles)
    log = make_log(LoggerSettings(type="tensorboard"), folder, "run")
    assert log is not None
    log("proposer", cycles[0], 20)
    log("curriculum", {"levels": [LEVEL] * 3}, 20)
    (events_folder,) = {file.parent for file in tmp_path.rglob("events.out.*")}
    events = EventAccumulator(str(events_folder)).Reload()
    assert [event.value for event in events.Scalars("proposer/total_gain_max")] == [0.25]
    assert [event.value for event in events.Scalars("proposer/total_gain_mean")] == [-0.125]
    (event,) = events.Images("curriculum/levels")
    expected = draw_grid(Level.from_text(["..#.\nS..G"] * 3), [LEVEL["path"]] * 3, columns=4)
    shown = Image.open(BytesIO(event.encoded_image_string))
    assert np.array_equal(np.asarray(shown), expected.numpy())
    (event,) = events.Images("proposer/histogram")
    assert event.step == 20 and event.width > 200

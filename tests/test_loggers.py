from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from proposer_rl.cli.config import ConfigError
from proposer_rl.cli.loggers import make_log, require_logger
from proposer_rl.settings import LoggerSettings
from tests.report.folders import LEVEL, PIXELS, cycle, write_run


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
    with pytest.raises(ConfigError, match=r"logger=wandb: .*install it with: .*\[wandb\]'?$"):
        require_logger(LoggerSettings(type="wandb", mode="disabled"))


def test_levels_and_proposals_go_to_tensorboard_as_images(tmp_path: Path) -> None:
    cycles = [cycle(0, [0.25, -0.5], [[6, 0, 0], [0, 0, 0]])]
    folder = write_run(tmp_path / "run", "perf_gain", cycles=cycles)
    log = make_log(LoggerSettings(type="tensorboard"), folder, "run")
    assert log is not None
    log("cycles", cycles[0], 20)
    log("cycles", {"levels": {"best": [LEVEL], "none": []}}, 20)
    log("curriculum", {"levels": [LEVEL, {"picture": "none"}, *[LEVEL] * 4]}, 20)
    (events_folder,) = {file.parent for file in tmp_path.rglob("events.out.*")}
    events = EventAccumulator(str(events_folder)).Reload()
    assert [event.value for event in events.Scalars("cycles/return_gain_max")] == [0.25]
    assert [event.value for event in events.Scalars("cycles/return_gain_mean")] == [-0.125]
    (event,) = events.Images("curriculum/levels")
    shown = np.asarray(Image.open(BytesIO(event.encoded_image_string)))
    assert shown.shape == (2 * 20 + 8, 4 * 40 + 3 * 8, 3)  # five pictures, four in a row
    assert np.array_equal(shown[:20, 48:88], PIXELS) and np.array_equal(shown[28:, :40], PIXELS)
    assert (shown[20:28] == 255).all() and (shown[28:, 48:] == 255).all()
    (event,) = events.Images("cycles/best")
    assert (event.height, event.width) == (20, 40)
    (event,) = events.Images("cycles/histogram")
    assert event.step == 20 and event.width > 200

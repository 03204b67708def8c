from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from functools import partial
from io import BytesIO
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from proposer_rl.cli.config import LoggerSettings
from proposer_rl.cli.errors import ConfigError
from proposer_rl.cli.loggers import log_of, logger, require_logger
from proposer_rl.cli.shown import last_map
from tests.report.folders import LEVEL, PIXELS, cycle, write_run

SMOKE = ["+method=target", "+scale=smoke", "compute.progress=false", "hydra.run.dir=run"]


def test_the_runs_folder_is_enough_for_csv(tmp_path: Path) -> None:
    with logger(LoggerSettings(type="csv"), tmp_path, "run", {}) as write:
        assert write is None


def test_rows_and_settings_go_to_tensorboard(tmp_path: Path) -> None:
    config = {"method": "plr", "solver": {"ppo": {"gamma": 0.9}}}
    with logger(LoggerSettings(type="tensorboard"), tmp_path, "run", config) as write:
        log = log_of(write, lambda: None)
        log("metrics", {"id_success": 0.25, "frames": 100}, 10)
        log("metrics", {"id_success": 0.5, "frames": 200}, 20)
        log("cycles", {"shares": {"way": [0.25, 0.75]}}, 20)
    (folder,) = {file.parent for file in tmp_path.rglob("events.out.*")}
    events = EventAccumulator(str(folder)).Reload()
    found = [(event.step, event.value) for event in events.Scalars("metrics/id_success")]
    assert found == [(10, 0.25), (20, 0.5)]
    assert [event.value for event in events.Scalars("cycles/shares/way")] == [0.5]
    (event,) = events.Tensors("config/solver/text_summary")
    assert event.tensor_proto.string_val == [b"{'ppo': {'gamma': 0.9}}"]


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("proposer_rl.cli.loggers.find_spec", {"tensorboard": object()}.get)
    require_logger(LoggerSettings(type="csv"))
    require_logger(LoggerSettings(type="tensorboard"))
    with pytest.raises(ConfigError, match=r"logger=wandb: .*install it with: .*\[wandb\]'?$"):
        require_logger(LoggerSettings(type="wandb", mode="disabled"))


def test_levels_and_proposals_go_to_tensorboard_as_images(tmp_path: Path) -> None:
    cycles = [cycle(0, [0.25, -0.5], [[6, 0, 0], [0, 0, 0]])]
    folder = write_run(tmp_path / "run", "perf_gain", cycles=cycles)
    with logger(LoggerSettings(type="tensorboard"), folder, "run", {}) as write:
        log = log_of(write, partial(last_map, folder))
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


class Stand(ModuleType):
    """In the place of the package wandb, which the tests' environment does not have."""

    Error = type("Error", (Exception,), {})

    def __init__(self) -> None:
        super().__init__("wandb")
        self.runs: list[dict[str, Any]] = []
        self.rows: list[tuple[int, dict[str, Any]]] = []
        self.ended: list[int] = []
        self.Image = lambda pixels: pixels.shape

    def login(self) -> None:
        raise self.Error("No API key configured.\nUse `wandb login` to log in.")

    def init(self, **options: Any) -> Stand:
        self.runs.append(options)
        return self

    def log(self, row: dict[str, Any], step: int) -> None:
        self.rows.append((step, row))

    def finish(self, exit_code: int = 0) -> None:
        self.ended.append(exit_code)


@pytest.fixture
def stand(monkeypatch: pytest.MonkeyPatch) -> Stand:
    module = Stand()
    monkeypatch.setitem(sys.modules, "wandb", module)
    monkeypatch.setattr("proposer_rl.cli.loggers.find_spec", lambda name: name)
    return module


@pytest.mark.usefixtures("own_folder")
@pytest.mark.parametrize("variable", [None, "online"])
def test_without_an_account_one_line_and_nothing_written(
    variable: str | None, stand: Stand, train, capsys, monkeypatch
) -> None:
    monkeypatch.delenv("WANDB_MODE", raising=False)
    if variable:
        monkeypatch.setenv("WANDB_MODE", variable)
    assert train(*SMOKE, "logger=wandb") == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("error: logger=wandb: No API key configured. Use `wandb login`")
    assert not Path("run").exists() and not stand.runs


def test_what_is_given_goes_before_the_variables_of_weights_and_biases(
    stand: Stand, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_PROJECT", "theirs")
    for given in ({}, {"mode": "disabled", "project": "ours"}):
        settings = LoggerSettings(type="wandb", **given)
        require_logger(settings)
        with (
            pytest.raises(ZeroDivisionError),
            logger(settings, tmp_path, "run", {"method": "plr"}),
        ):
            _ = 1 / 0
    first, second = stand.runs
    assert (first["mode"], first["project"]) == (None, "theirs")
    assert (second["mode"], second["project"]) == ("disabled", "ours")
    assert first["id"] == second["id"] == (tmp_path / "wandb_id.txt").read_text()
    assert first["resume"] == "allow" and first["config"] == {"method": "plr"}
    assert stand.ended == [1, 1]


def records(folder: Path) -> Iterator[Any]:
    """What Weights & Biases has written of a run without a network."""
    from wandb.proto.wandb_internal_pb2 import Record
    from wandb.sdk.internal.datastore import DataStore

    (file,) = folder.glob("*.wandb")
    store = DataStore()
    store.open_for_scan(str(file))
    while (data := store.scan_data()) is not None:
        yield Record.FromString(data)


@pytest.mark.usefixtures("own_folder")
@pytest.mark.pictures
def test_a_run_that_goes_on_is_the_same_at_weights_and_biases(train, monkeypatch) -> None:
    """With the package itself, where it is installed."""
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    for updates in (4, 6):
        assert train(*SMOKE, "logger=wandb", "seed=3", f"schedule.updates={updates}") == 0
    folders = sorted(Path("run/wandb").glob("offline-run-*"), key=lambda one: one.stat().st_mtime)
    assert len(folders) == 2
    steps: list[int] = []
    for folder in folders:
        found = list(records(folder))
        (run,) = (record.run for record in found if record.HasField("run"))
        assert run.run_id == Path("run/wandb_id.txt").read_text()
        config = {item.key: json.loads(item.value_json) for item in run.config.update}
        assert (config["method"], config["seed"]) == ("target", 3)
        assert config["solver"]["ppo"]["learning_rate"] == 2.5e-4
        rows = [
            {"/".join(item.nested_key) or item.key: json.loads(item.value_json) for item in h.item}
            for h in (record.history for record in found if record.HasField("history"))
        ]
        steps += [row["_step"] for row in rows]
        for row in rows:
            assert "metrics/id_success" in row
            trained = {"training/loss_critic", "curriculum/levels/path"} <= row.keys()
            assert trained == (row["_step"] > 0)
        assert "run/path" in rows[-1]
    assert steps == [0, 2, 4, 6]

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from signal import SIGKILL
from types import ModuleType
from typing import Any

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import proposer_rl
from proposer_rl.cli.config import LoggerSettings
from proposer_rl.cli.loggers import logger
from proposer_rl.runs.folder import read_csv, read_jsonl
from tests import commands
from tests.processes import Processes

BLOCK = 2**15  # bytes, of a file of Weights & Biases
LITTLE = [*commands.SMOKE, "schedule.checkpoint_every=2", "schedule.updates=6"]
SMOKE = ["+method=target", "+scale=smoke", "compute.progress=false", "hydra.run.dir=run"]


def test_the_runs_folder_is_enough_for_csv(tmp_path: Path) -> None:
    with logger(LoggerSettings(type="csv"), tmp_path, "run", {}) as log:
        assert log is None


def scalars(folder: Path, name: str) -> list[tuple[int, float]]:
    """The points of a curve, as TensorBoard shows it."""
    (events,) = {file.parent for file in folder.rglob("events.out.*")}
    found = EventAccumulator(str(events)).Reload()
    return [(event.step, event.value) for event in found.Scalars(name)]


def test_rows_and_settings_go_to_tensorboard(tmp_path: Path) -> None:
    config = {"method": "plr", "solver": {"ppo": {"gamma": 0.9}}}
    with logger(LoggerSettings(type="tensorboard"), tmp_path, "run", config) as log:
        log("metrics", {"id_success": 0.25, "frames": 100}, 10)
        log("metrics", {"id_success": 0.5, "frames": 200}, 20)
        log("cycles", {"shares": {"way": [0.25, 0.75]}, "gain": [0.5, -1.0], "levels": {}}, 20)
    assert scalars(tmp_path, "metrics/id_success") == [(10, 0.25), (20, 0.5)]
    assert scalars(tmp_path, "cycles/shares/way") == [(20, 0.5)]
    assert scalars(tmp_path, "cycles/gain_max") == [(20, 0.5)]
    assert scalars(tmp_path, "cycles/gain_mean") == [(20, -0.25)]
    (folder,) = {file.parent for file in tmp_path.rglob("events.out.*")}
    (event,) = EventAccumulator(str(folder)).Reload().Tensors("config/solver/text_summary")
    assert event.tensor_proto.string_val == [b"{'ppo': {'gamma': 0.9}}"]


def test_a_run_that_was_killed_and_goes_on_has_each_step_once_in_tensorboard(
    processes: Processes, tmp_path: Path
) -> None:
    """As lanpa/tensorboardX#185; rows after its last checkpoint are logged twice."""
    command = ["+method=plr", *LITTLE, "logger=tensorboard", "schedule.cycle_length=2"]
    whole = processes(*command, f"hydra.run.dir={tmp_path / 'whole'}")
    assert whole.code == 0, whole.output
    rows = [at for at, write in enumerate(whole.writes) if write == "fsync metrics.csv"]
    run = [*command, f"hydra.run.dir={tmp_path / 'run'}"]
    for row in (rows[1], rows[2]):  # before the first checkpoint of its own, and after it
        assert processes(*run, signal_at={row + 2: int(SIGKILL)}).code == -SIGKILL
    assert processes(*run).code == 0
    assert processes(*run, "schedule.updates=8").code == 0
    for table, name in (("metrics.csv", "id_success"), ("training.csv", "loss_critic")):
        kept = [(row["updates"], row[name]) for row in read_csv(tmp_path / "run" / table)]
        logged = scalars(tmp_path / "run", f"{table[:-4]}/{name}")
        assert [step for step, _ in logged] == [step for step, _ in kept]
        assert [value for _, value in logged] == pytest.approx([value for _, value in kept])
    logged = scalars(tmp_path / "run", "cycles/cycle")
    cycles = read_jsonl(tmp_path / "run" / "cycles.jsonl")
    assert logged == [(row["updates"], row["cycle"]) for row in cycles]


def records(folder: Path) -> Iterator[Any]:
    """What Weights & Biases has written of a run without a network, in LevelDB's format of logs."""
    from wandb.proto.wandb_internal_pb2 import Record

    (file,) = folder.glob("*.wandb")
    content, at, data = file.read_bytes(), 7, b""
    while at + 7 <= len(content):
        if (left := BLOCK - at % BLOCK) < 7:
            at += left
            continue
        length, kind = struct.unpack("<HB", content[at + 4 : at + 7])
        at += 7 + length
        data += content[at - length : at]
        if kind in (1, 4):  # whole, or the last part of one
            yield Record.FromString(data)
            data = b""


@pytest.fixture
def offline(own_folder: None, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The package itself, where it is installed, without a network."""
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    return pytest.importorskip("wandb")


def test_a_run_of_the_callers_own_at_weights_and_biases_goes_on(offline: Any) -> None:
    own = offline.init(project="own")
    little = {"logger": {"type": "wandb"}, "solver": {"ppo": {"horizon": 5, "epochs": 1}}}
    for seed in (0, 1):
        task = proposer_rl.tasks.maze()
        folder = Path(f"run_{seed}")
        options = {"scale": "smoke", "updates": 1, "seed": seed, "settings": little}
        proposer_rl.train(task, "target", folder=folder, progress=False, **options)
        assert offline.run is own and own.id != (folder / "wandb_id.txt").read_text()
        own.log({"seed": seed})
    own.finish()
    (folder,) = Path("wandb").glob("offline-run-*")
    assert sum(record.HasField("history") for record in records(folder)) == 2


@pytest.mark.usefixtures("offline")
def test_a_run_that_goes_on_is_the_same_at_weights_and_biases(train) -> None:
    for updates in (4, 6):
        assert train(*SMOKE, "logger=wandb", "seed=3", f"schedule.updates={updates}") == 0
    folders = sorted(Path("run/wandb").glob("offline-run-*"), key=lambda one: one.stat().st_mtime)
    assert len(folders) == 2
    steps: list[list[int]] = []
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
        steps.append([row["_step"] for row in rows])
        for row in rows:
            assert "metrics/id_success" in row
            assert ("training/loss_critic" in row) == (row["_step"] > 0)
    assert steps == [[0, 2, 4], [4, 6]]  # of a step that is there the first row stays

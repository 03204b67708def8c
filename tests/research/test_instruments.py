"""``bin/research snr`` and ``conditioning`` as users call them, on short runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from proposer_rl.cli.train import main as train
from research.conditioning import main as look
from research.snr import EXPLORATIONS
from research.snr import main as snr
from tests.commands import call, trained_run

pytestmark = pytest.mark.slow  # whole runs, for what is no part of the package

SMOKE = ["+scale=smoke", "compute.progress=false", "schedule.keep_checkpoints=2"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained_run(tmp_path_factory.mktemp("runs") / "learnt", "+method=perf_gain", *SMOKE)


@pytest.mark.slow
def test_signal_and_noise_of_every_checkpoint(run: Path, tmp_path: Path, capsys) -> None:
    output = tmp_path / "snr.json"
    sizes = ["--proposals", "2", "--copies", "2", "--levels", "2", "4", "--output", str(output)]
    assert call(snr, str(run), *sizes) == 0
    rows = json.loads(output.read_text())
    stages = sorted({row["updates"] for row in rows})
    assert stages == [4, 6]
    assert len(rows) == len(stages) * len(EXPLORATIONS) * 2 * 2
    by_return, by_logarithm = (
        [row for row in rows if row["measure"] == name] for name in ("return", "log_success")
    )
    assert all(
        one["mean"] != other["mean"] for one, other in zip(by_return, by_logarithm, strict=True)
    )
    said = capsys.readouterr().out
    assert "learnt: total gain over 3 updates" in said and "uneven" in said
    assert call(snr, str(run), *sizes) == 0
    assert json.loads(output.read_text()) == rows


def test_look_shows_every_stage_and_what_changes(run: Path, tmp_path: Path, capsys) -> None:
    output = tmp_path / "look.json"
    assert call(look, str(run), str(run), "--output", str(output)) == 0
    rows = json.loads(output.read_text())
    asis = [row for row in rows if row["seen"] == "as it is"]
    assert [row["updates"] for row in asis] == [4, 6]
    for row in rows:
        easy, hard = row["shares"]  # of the obstacle fractions 0 and 0.2
        assert sum(easy) + sum(hard) == pytest.approx(1)
        assert row["obstacle fraction"] == pytest.approx(0.2 * sum(hard))
        assert row["path length"] == pytest.approx(2 + 2 * (easy[1] + hard[1]))
        assert 0 <= row["distance"] <= 1
    assert all(row["distance"] == 0 for row in asis)
    # The first stage cannot be shown its own probes, nor the last its own.
    assert [row["seen"] for row in rows if row["updates"] == 4] == [
        "as it is", "probes of the last", "log_success of the last",
    ]  # fmt: skip
    assert "as it is" in capsys.readouterr().out


def test_look_shows_the_first_of_several_solvers(run: Path, tmp_path: Path) -> None:
    both, alone = tmp_path / "both", tmp_path / "alone"
    assert call(train, "+method=target", *SMOKE, "seeds=[0,1]", f"hydra.run.dir={both}") == 0
    assert call(train, "+method=target", *SMOKE, "seed=0", f"hydra.run.dir={alone}") == 0
    rows = []
    for folder in (both, alone):
        output = tmp_path / "look.json"
        assert call(look, str(run), str(folder), "--output", str(output)) == 0
        rows.append([row["distance"] for row in json.loads(output.read_text())])
    assert rows[0] == pytest.approx(rows[1], abs=1e-3) and len(rows[0]) > 2

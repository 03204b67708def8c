"""``bin/research foresight``: predicted gains against measured ones, on a run of a few updates."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import spearmanr
from tensordict import TensorDict

from research.foresight import agreement
from research.foresight import main as foresight
from tests.commands import call, trained_run

pytestmark = pytest.mark.usefixtures("own_folder")


def test_agreement_is_that_of_ranks_and_of_a_line() -> None:
    predicted = np.linspace(-1, 1, 9)
    exact = agreement(predicted, 3 * predicted + 1)
    assert exact["rank"] == pytest.approx(1) and exact["explained"] == pytest.approx(1)
    assert exact["slope"] == pytest.approx(3) and exact["slope_error"] == pytest.approx(0)
    # Ranks see any rising curve; a line sees less of it.
    bent = agreement(predicted, np.exp(4 * predicted))
    assert bent["rank"] == pytest.approx(1) and bent["explained"] < 0.8
    assert agreement(predicted, -predicted)["rank"] == pytest.approx(-1)
    mixed = np.random.default_rng(0).permutation(9)
    assert agreement(predicted, mixed)["rank"] == pytest.approx(spearmanr(predicted, mixed)[0])


def test_the_interval_covers_no_correlation_where_there_is_none() -> None:
    generator = np.random.default_rng(0)
    found = [agreement(*generator.normal(size=(2, 16))) for _ in range(20)]
    covered = sum(row["low"] <= 0 <= row["high"] for row in found)
    assert covered >= 16  # 19 of 20 on average


def growing(rates: torch.Tensor):
    """In place of training: after n updates the logarithms of success + 0.001 grew by n mixes."""

    def performance_at(steps, env, solver, actions, levels, streams):
        rate = actions[0].softmax(-1) @ rates  # [G]
        grown = [0.002 * (n * rate).exp()[:, None, None].expand(-1, 2, 8) for n in steps]
        return [TensorDict({"success": each - 0.001}, each.shape) for each in grown]

    return performance_at


def test_every_checkpoint_and_every_number_of_updates_gets_a_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    smoke = ["+method=target", "+scale=smoke", "compute.progress=false", "schedule.updates=2"]
    run, output = trained_run(tmp_path / "run", *smoke), tmp_path / "rows.json"
    sizes = ["--ahead", "1", "2", "--proposals", "4", "--copies", "1", "--levels", "8"]
    command = [str(run), *sizes, "--output", str(output)]
    assert call(foresight, *command) == 0
    rows = json.loads(output.read_text())
    stages = len(list((run / "checkpoints").glob("*.pt")))
    assert [row["ahead"] for row in rows] == [1, 2] * stages
    # Were bins worth 0 to 3, and logarithms of successes to grow by twice what a mix is worth:
    worth = torch.arange(4.0)
    monkeypatch.setattr("research.foresight._scores", lambda *_: worth)
    monkeypatch.setattr("research.foresight.performance_at", growing(2 * worth))
    assert call(foresight, *command) == 0
    for row in json.loads(output.read_text()):
        assert (row["rank"], row["explained"]) == pytest.approx((1, 1))
        assert row["slope"] == pytest.approx(2 * row["ahead"], rel=1e-3)
    assert call(foresight, str(run), *sizes[:3], "--proposals", "3") == 2
    assert "--proposals: must be a whole number of at least 4, got '3'" in capsys.readouterr().err

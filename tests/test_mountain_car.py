"""Tasks of other kinds go through the commands as mazes do: cars, and the shortest task."""

from __future__ import annotations

import json
import re
from pathlib import Path
from signal import SIGKILL

import numpy as np
import pytest
from PIL import Image

from proposer_rl.cli.eval import main as evaluate
from proposer_rl.cli.play import open_session
from proposer_rl.cli.report import main as report
from proposer_rl.cli.watch import main as watch
from proposer_rl.play.session import Drawn, OfCurriculum
from proposer_rl.runs.folder import read_csv
from tests.commands import trained_run
from tests.processes import Processes
from tests.same_run import assert_same_run
from tests.tiny import EXAMPLES

TRAIN = [
    *("--config-dir", f"{EXAMPLES}/conf"),
    *("task=mountain_car", "+method=perf_gain", "compute.progress=false", "schedule.updates=6"),
    *("proposer.meta_episode_length=2", "proposer.action_repeat=1", "proposer.rollouts=2"),
    *("task.levels=8", "solver.ppo.horizon=10", "schedule.checkpoint_every=2"),
]


@pytest.mark.slow
def test_it_trains_is_killed_goes_on_and_is_looked_at(
    processes: Processes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    whole, run = tmp_path / "whole", tmp_path / "run"
    ended = processes(*TRAIN, f"hydra.run.dir={whole}")
    assert ended.code == 0, ended.output
    # At the write that follows the first checkpoint.
    saved = [name.startswith("replace .step_") for name in ended.writes].index(True)
    killed = processes(*TRAIN, f"hydra.run.dir={run}", signal_at={saved + 1: int(SIGKILL)})
    assert killed.code == -SIGKILL, killed.output
    assert len(list(run.glob("checkpoints/*.pt"))) == 1
    ended = processes(*TRAIN, f"hydra.run.dir={run}")
    assert ended.code == 0, ended.output
    assert_same_run(whole, run)
    assert {"target_success", "all_success"} <= read_csv(run / "metrics.csv")[-1].keys()
    watch([str(run), "--once"])
    assert "target success" in capsys.readouterr().out
    report([str(run), "-o", str(tmp_path / "report")])
    page = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    page = re.sub(r'<script.*?</script>|base64,[^"]*', "", page, flags=re.DOTALL)  # what is packed
    assert "mountain cars" in page and "maze" not in page.casefold()
    assert "Cars of that batch" in page
    drawn = np.asarray(Image.open(run / "run.png").convert("RGB")).astype(int)
    # The valley's ground and its top, in the task's own colours.
    ground, top = (np.abs(drawn - c).max(-1) <= 3 for c in ((250, 250, 250), (230, 159, 0)))
    assert ground.mean() > 0.1 and top.any()


def test_the_shortest_task_has_every_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    run = trained_run(
        tmp_path / "run",
        *("--config-dir", f"{EXAMPLES}/conf", "task=own_task", "+method=domain_randomization"),
        *("compute.progress=false", "schedule.updates=4", "task.levels=8", "solver.batch_size=4"),
        *("seeds=[0,1]", "solver.ppo.horizon=10"),
    )
    measured = read_csv(run / "metrics.csv")[-1]
    assert {"target_success", "target_return", "all_success"} <= measured.keys()
    trained = read_csv(run / "training.csv")[-1]
    assert 1 <= trained["distance"] <= 9 and 0 <= trained["wind"] <= 1
    watch([str(run), "--once"])
    assert "target success" in capsys.readouterr().out
    evaluate([str(run), "--levels", "all", "-o", str(tmp_path / "rows.json")])
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert len(rows) == 2 * 8 and all(0 <= row["success"] <= 1 for row in rows)
    with pytest.raises(SystemExit):
        evaluate([str(run), "--levels", "here"])
    assert "--levels here: must be one of: target, all" in capsys.readouterr().err
    session = open_session(run)
    assert session.about()["board"] is None and session.about()["task_levels"] == "sledges"
    drawn = Drawn(source="distribution", name="target", seed=3, checkpoint=1, solver=1)
    for shown in (session.levels(drawn), session.levels(OfCurriculum(source="curriculum", row=0))):
        assert all(level["picture"] and "wind" in level["text"][1] for level in shown["levels"])
    report([str(run), "-o", str(tmp_path / "report")])
    assert "Sledges of that batch" in (tmp_path / "report" / "report.html").read_text("utf-8")

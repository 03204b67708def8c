"""A task of another kind goes through the commands as mazes do."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from pathlib import Path
from signal import SIGKILL

import numpy as np
import pytest
from PIL import Image

from proposer_rl.runs.folder import read_csv
from tests.same_run import assert_same_run

ROOT = Path(__file__).parents[1]
TRAIN = [
    *("-m", "proposer_rl.cli.start", "--config-dir", str(ROOT / "examples" / "conf")),
    *("task=mountain_car", "+method=perf_gain", "compute.progress=false", "schedule.updates=6"),
    *("proposer.meta_episode_length=2", "proposer.action_repeat=1", "proposer.rollouts=2"),
    *("task.levels=8", "solver.ppo.horizon=10", "schedule.checkpoint_every=2"),
]
ENVIRONMENT = os.environ | {
    "PYTHONPATH": f"{ROOT / 'examples'}{os.pathsep}{ROOT}",
    "OMP_NUM_THREADS": "1",
}


def call(*arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, *arguments], env=ENVIRONMENT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_it_trains_is_killed_goes_on_and_is_looked_at(tmp_path: Path) -> None:
    whole, run = tmp_path / "whole", tmp_path / "run"
    call(*TRAIN, f"hydra.run.dir={whole}")
    process = subprocess.Popen(
        [sys.executable, *TRAIN, f"hydra.run.dir={run}"],
        env=ENVIRONMENT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    while not list(run.glob("checkpoints/*.pt")):
        assert process.poll() is None
        time.sleep(0.01)
    process.kill()
    assert process.wait() == -SIGKILL
    call(*TRAIN, f"hydra.run.dir={run}")
    assert_same_run(whole, run)
    assert {"target_success", "all_success"} <= read_csv(run / "metrics.csv")[-1].keys()
    assert "gravity" in call("-m", "proposer_rl.cli.watch", str(run), "--once")
    call("-m", "proposer_rl.cli.report", str(run), "-o", str(tmp_path / "report"))
    page = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    page = re.sub(r'<script.*?</script>|base64,[^"]*', "", page, flags=re.DOTALL)  # what is packed
    assert "mountain cars" in page and "maze" not in page.casefold()
    for figure, heading in (("levels", "Cars along training"), ("samples", "Sample cars")):
        assert heading in page
        file = tmp_path / "report" / "figures" / f"{figure}.png"
        drawn = np.asarray(Image.open(file).convert("RGB")).astype(int)
        # The valley's ground and its top, in the task's own colours.
        ground, top = (np.abs(drawn - c).max(-1) <= 3 for c in ((250, 250, 250), (230, 159, 0)))
        assert ground.mean() > 0.1 and top.any()

"""A long run needs no more memory and no more open files than a short one.

Here 60 updates and 20 cycles; ``LONG_RUN_UPDATES=2000 pytest -s tests/test_long_run.py`` is long.
"""

from __future__ import annotations

import gc
import os
import resource
from pathlib import Path

import pytest

from proposer_rl.cli.build import build, parts
from proposer_rl.runs.folder import RunFolder
from proposer_rl.runs.process import StopSignals
from tests.tiny import composed

UPDATES = int(os.environ.get("LONG_RUN_UPDATES", "60"))
CYCLES = 20
MIB = 2**20


def resident() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / MIB


@pytest.mark.slow
def test_memory_and_open_files_stay_flat(tmp_path: Path) -> None:
    options = [
        *("+method=perf_gain", "+scale=smoke", "proposer.meta_episode_length=2"),
        *("compute.progress=false", "solver.ppo.horizon=5", "solver.ppo.epochs=1"),
        *(f"schedule.updates={UPDATES}", f"schedule.cycle_length={UPDATES // CYCLES}"),
        *(f"schedule.evaluate_every={UPDATES // CYCLES}", "schedule.checkpoint_every=20"),
    ]
    config = composed(*options)
    memory, files = [], []

    def sample(table: str, row: object, step: int) -> None:
        if table == "metrics":
            gc.collect()
            memory.append(resident())
            files.append(len(os.listdir("/proc/self/fd")))

    made = parts(config, StopSignals())
    experiment = build(config, made, RunFolder(tmp_path), log=sample)
    gc.collect()
    gc.freeze()  # what all modules hold is looked through once, not at every sample
    try:
        experiment.run()
    finally:
        gc.unfreeze()
    assert experiment.cycles == CYCLES and len(memory) == CYCLES + 1
    print(f"\nMiB: {[round(m) for m in memory]}\nopen files: {files}")
    # The first quarter fills caches and pools; what leaks goes on.
    start = len(memory) // 4
    assert memory[-1] - memory[start] < 8
    assert set(files[1:]) == {files[-1]}

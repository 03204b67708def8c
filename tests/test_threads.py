"""Every command sets how PyTorch waits and keeps memory before it loads it, unless the user has."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys

import pytest

from proposer_rl.cli import KEPT
from tests.test_packaging import PROJECT

ASK = """
import importlib, os, sys
importlib.import_module(sys.argv[1])
print(os.environ.get("GOMP_SPINCOUNT"), "torch" in sys.modules)
"""
SCRIPTS = {script.partition(":")[0] for script in PROJECT["scripts"].values()}
MODULES = sorted({*SCRIPTS, "research.__main__", "research.benchmarks.__main__"})


def waits(module: str, **given: str) -> list[str]:
    kept = {k: v for k, v in os.environ.items() if k not in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")}
    command = [sys.executable, "-c", ASK, module]
    said = subprocess.run(command, env=kept | given, capture_output=True, text=True, check=True)
    return said.stdout.split()


@pytest.mark.parametrize("module", MODULES)
def test_a_command_says_how_threads_wait_before_it_loads_pytorch(module: str) -> None:
    assert waits(module) == ["1000", "False"]


def test_what_the_user_says_counts() -> None:
    assert waits("proposer_rl.cli.start", GOMP_SPINCOUNT="7")[0] == "7"
    assert waits("proposer_rl.cli.start", OMP_WAIT_POLICY="active")[0] == "None"


# A tensor's memory is asked for and given back like this, and each of its pages is written to.
USE = """
import ctypes, importlib, resource, sys
importlib.import_module(sys.argv[1])
c, place = ctypes.CDLL(None), ctypes.c_void_p()
counts = []
for turn in range(8):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    assert c.posix_memalign(ctypes.byref(place), 64, 40 * 2**20) == 0  # 10,240 pages
    ctypes.memset(place, 1, 40 * 2**20)
    c.free(place)
    counts.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
print(min(counts))  # what lies between may move a block to new pages now and then
"""
GLIBC = sys.platform == "linux" and hasattr(ctypes.CDLL(None), "mallopt")


@pytest.mark.skipif(not GLIBC, reason="needs glibc's malloc")
def test_memory_that_was_used_is_kept_unless_the_user_says_otherwise() -> None:
    def faults(module: str = "proposer_rl.cli.start", **given: str) -> int:
        kept = {k: v for k, v in os.environ.items() if not k.startswith(("MALLOC_", "GLIBC_"))}
        command = [sys.executable, "-c", USE, module]
        said = subprocess.run(command, env=kept | given, capture_output=True, text=True, check=True)
        return int(said.stdout)

    # Where the kernel puts the heap right below another mapping it cannot grow.
    if faults("json", **{name: str(value) for name, (_, value) in KEPT.items()}) >= 1000:
        pytest.skip("the C library keeps no memory here, even where it is told so directly")
    assert any(faults() < 1000 for _ in range(3))
    assert any(faults(MALLOC_ARENA_MAX="2") < 1000 for _ in range(3))
    assert faults(MALLOC_TRIM_THRESHOLD_="131072") > 5000

"""Runs one benchmark in a process of its own, so that its peak memory is its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import traceback
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from research.benchmarks.memory import peak_memory
from research.benchmarks.registry import measure
from research.benchmarks.results import Options


class BenchmarkFailed(Exception):
    """A benchmark's process ended without a result; the message says why."""


def run_apart(name: str, options: Options, threads: int | None) -> dict[str, Any]:
    """Run a benchmark in a fresh process; without a number of threads, torch chooses.

    Returns:
        ``seconds``, ``peak_memory`` in bytes, ``threads``, and the ``result`` as plain dicts; on
        CUDA also ``peak_device_memory``.

    Raises:
        BenchmarkFailed: if there was no result.
    """
    environment = dict(os.environ)
    if threads is not None:
        # From the start, since OpenMP makes its threads when it is first used.
        environment["OMP_NUM_THREADS"] = environment["MKL_NUM_THREADS"] = str(threads)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "result.json"
        arguments = [name, json.dumps(asdict(options)), str(threads or 0), str(file)]
        ended = subprocess.run(
            [sys.executable, "-m", __spec__.name, *arguments],
            env=environment,
            stdout=subprocess.DEVNULL,  # but not what says how far it is
        )
        if not file.exists():
            raise BenchmarkFailed(f"exit code {ended.returncode}")
        content: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    if "error" in content:
        raise BenchmarkFailed(content["error"])
    return content


def main() -> None:
    """Entry point of that process: name, options, threads (0: torch's choice), result file."""
    name, options, threads, file = sys.argv[1:]
    if int(threads):
        torch.set_num_threads(int(threads))
    torch.manual_seed(0)
    chosen = Options(**json.loads(options))
    try:
        start = time.perf_counter()
        result = measure(name, chosen)
        content: dict[str, Any] = {
            "seconds": time.perf_counter() - start,
            "peak_memory": peak_memory(),
            "threads": torch.get_num_threads(),
            "result": result.to_json(),
        }
        if chosen.device.startswith("cuda"):
            content["peak_device_memory"] = torch.cuda.max_memory_allocated(chosen.device)
    except Exception:
        content = {"error": traceback.format_exc().strip()}
    Path(file).write_text(json.dumps(content), encoding="utf-8")


if __name__ == "__main__":
    main()

"""Measure what ``bin/bench`` was asked, print tables, write a JSON file."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NoReturn

import torch

from proposer_rl.cli.errors import SIGNALLED, ConfigError
from proposer_rl.runs.folder import write_atomically
from research.benchmarks.curricula import read_methods
from research.benchmarks.gymnasium import ENVIRONMENTS
from research.benchmarks.jaxued_peer import __file__ as JAXUED
from research.benchmarks.peer import said_by
from research.benchmarks.registry import BENCHMARKS, selected
from research.benchmarks.report import describe, machine, summary, versions
from research.benchmarks.results import Options, Result, Size
from research.benchmarks.syllabus_peer import __file__ as SYLLABUS
from research.benchmarks.worker import BenchmarkFailed, run_apart

FAILED = 1
TERMINATED = SIGNALLED + signal.SIGTERM


def answer(arguments: argparse.Namespace) -> None:
    """Ends with 0 if all was measured, 1 if a benchmark failed.

    Raises:
        ConfigError: for bad input.
        StorageError: if the results cannot be written.
    """
    if arguments.list:
        _list()
        return
    unknown = [name for name in arguments.names if name not in BENCHMARKS]
    if unknown:
        raise ConfigError(
            f"unknown benchmark {unknown[0]!r}; choose among: {', '.join(BENCHMARKS)}"
        )
    if not arguments.output.parent.is_dir():
        raise ConfigError(f"--output: there is no folder {arguments.output.parent}")
    # Told to end, it ends the benchmark's process too.
    before = signal.signal(signal.SIGTERM, _terminated)
    try:
        sys.exit(_run(arguments.names, _options(arguments), arguments.threads, arguments.output))
    finally:
        signal.signal(signal.SIGTERM, before)


def _run(names: list[str], options: Options, threads: int | None, output: Path) -> int:
    """Run benchmarks, each in a process of its own; write the file and return the exit code."""
    chosen = selected(names, options.size == "full", options.device.startswith("cuda"))
    content: dict[str, Any] = {
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": machine(options.device),
        "versions": versions(),
        "options": asdict(options),
        "benchmarks": {},
    }
    results, start = [], time.perf_counter()
    for number, name in enumerate(chosen, 1):
        place = f"[{number}/{len(chosen)}] {name}"
        _say(f"{place}: {BENCHMARKS[name].about} ...")
        try:
            measured = run_apart(name, options, threads)
        except BenchmarkFailed as failure:
            measured = {"error": str(failure)}
            _say(f"{place}: failed\n{failure}")
        else:
            results.append(Result.from_json(measured["result"]))
            memory = f"{measured['peak_memory'] / 2**20:,.0f} MiB at most"
            _say(f"{place}: {measured['seconds']:.1f} s, {memory}")
        content["benchmarks"][name] = measured
        content["seconds"] = time.perf_counter() - start
        write_atomically(output, json.dumps(content, indent=1).encode())
    details = [text for result in results if (text := describe(result))]
    rows = [summary(results)] if any(result.rows for result in results) else []
    print("\n\n".join([*details, *rows]))
    if options.tiny:
        _say("At this size nothing is a measurement: it is to see that everything runs.")
    _say(f"{content['seconds']:.0f} s. File: {output}")
    return FAILED if len(results) < len(chosen) else 0


def _options(arguments: argparse.Namespace) -> Options:
    device = arguments.device
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ConfigError(f"--device {device}: {str(error).splitlines()[0]}") from error
    size: Size = "full" if arguments.full else "tiny" if arguments.tiny else "normal"
    if arguments.jaxued is not None:
        if torch.device(device).type != "cpu":
            raise ConfigError(
                f"--jaxued {arguments.jaxued}: JAX is measured on the CPU; give --device cpu, not "
                f"{device}"
            )
        _check_peer("jaxued", arguments.jaxued, JAXUED, ("view", "view_training"), arguments.names)
    if arguments.syllabus is not None:
        _check_peer("syllabus", arguments.syllabus, SYLLABUS, ("teacher",), arguments.names)
    if arguments.runs:
        _check_runs(arguments.runs, arguments.names)
    unknown = [name for name in arguments.environments if name not in ENVIRONMENTS]
    if unknown:
        raise ConfigError(f"--environments {unknown[0]}: must be among {', '.join(ENVIRONMENTS)}")
    return Options(
        arguments.repeats,
        arguments.precision,
        device,
        size,
        arguments.jaxued,
        arguments.syllabus,
        arguments.runs,
        arguments.seeds,
        arguments.environments,
        str(arguments.output.with_name("gymnasium.csv").absolute()),
    )


def _check_peer(
    peer: str, python: str, program: str, benchmarks: tuple[str, ...], names: list[str]
) -> None:
    if names and not set(benchmarks) & set(names):
        raise ConfigError(
            f"--{peer} {python}: is for the benchmark {' and '.join(benchmarks)}, not for "
            f"{', '.join(names)}"
        )
    try:
        said_by(python, program)
    except ValueError as error:
        raise ConfigError(
            f"--{peer} {python}: {error}; must be an interpreter that can import {peer}"
        ) from error


def _check_runs(folders: list[str], names: list[str]) -> None:
    if names != ["curricula"]:
        raise ConfigError(
            f"--runs: is for the benchmark curricula, not for {', '.join(names) or 'all'}"
        )
    try:
        read_methods(folders)
    except ValueError as error:
        raise ConfigError(f"--runs: {error}") from error


def _list() -> None:
    remarks = {
        "default": "",
        "full": " [with --full or by name]",
        "cuda": " [on a GPU]",
        "request": " [by name]",
    }
    for name, benchmark in BENCHMARKS.items():
        print(f"{name:<15} {benchmark.about}{remarks[benchmark.on]}")


def _terminated(*_: object) -> NoReturn:
    sys.exit(TERMINATED)


def _say(message: str) -> None:
    print(message, file=sys.stderr, flush=True)

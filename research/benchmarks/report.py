"""The printed tables, and what is known of the machine."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import torch

from proposer_rl.runs.process import processor
from research.benchmarks.results import Result, Row, Spread, Unit

HEADER = ["what", "against", "measured", "from – to", "target", "reached"]
PACKAGES = ("proposer_rl", "torchrl", "tensordict", "gymnasium", "networkx", "scipy")


def machine(device: str) -> dict[str, Any]:
    """What the numbers depend on besides the code."""
    found: dict[str, Any] = {
        "device": device,
        "processor": processor(),
        "cores": os.cpu_count(),
        "instructions": torch.backends.cpu.get_cpu_capability(),
        "avx512_bf16": torch.cpu._is_avx512_bf16_supported(),
        "amx": torch.cpu._is_amx_tile_supported(),
        "system": f"{platform.system()} {platform.machine()}",
    }
    if device.startswith("cuda"):
        found["gpu"] = torch.cuda.get_device_name(device)
    return found


def versions() -> dict[str, str]:
    """Python's and the packages'; those that are not installed are left out."""
    found = {"python": platform.python_version(), "torch": str(torch.__version__)}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def describe(result: Result) -> str:
    """A benchmark's details and notes; empty if it has none."""
    parts = [f"{table.title}:\n\n{markdown(table.header, table.lines)}" for table in result.tables]
    return "\n\n".join(parts + result.notes)


def summary(results: Sequence[Result]) -> str:
    """The table of all rows."""
    return markdown(HEADER, [_cells(row) for result in results for row in result.rows])


def markdown(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A Markdown table with aligned columns."""
    columns = list(zip(header, *lines, strict=True))
    widths = [max(3, *(len(cell) for cell in column)) for column in columns]
    rule = ["-" * width for width in widths]
    return "\n".join(
        "| "
        + " | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True))
        + " |"
        for line in (header, rule, *lines)
    )


def _cells(row: Row) -> list[str]:
    target = ""
    if row.target is not None:
        target = f"{'≤' if row.at_most else '≥'} {number(row.target, row.unit)}"
    reached = {None: "", True: "yes", False: "no"}[row.reached]
    return [row.what, row.against, number(row.value.median, row.unit), _range(row), target, reached]


def _range(row: Row) -> str:
    value: Spread = row.value
    if value.low == value.high:
        return ""
    return f"{number(value.low, row.unit)} – {number(value.high, row.unit)}"


def number(value: float, unit: Unit) -> str:
    """A number with its unit, to two or three figures."""
    if unit == "%":
        return f"{100 * value:.1f} %"
    if unit == "/s":
        return f"{value:,.0f} /s"
    if unit == "ms":
        return f"{1e3 * value:.3g} ms"
    digits = next((d for d, least in enumerate((100, 10, 0.1)) if abs(value) >= least), 3)
    return f"{value:.{digits}f}{'x' if unit == 'x' else ' ' + unit}"

"""Where the time of a call goes, by kind of operation."""

from __future__ import annotations

import re
import time
from collections import defaultdict
from collections.abc import Callable

import torch
from torch.profiler import ProfilerActivity
from torch.profiler import profile as torch_profile

from research.benchmarks.results import Table

# The first whose pattern is found in an operation's name is its kind.
KINDS = {
    "convolution": r"conv",
    "normalisation": r"group_?norm|layer_?norm",
    "activation and pooling": r"relu|threshold|pool",
    "optimiser and gradient norm": r"adam|foreach|vector_norm|optimizer",
    "upsampling and matrix products": r"upsample|mm\b|matmul|mmbackward",
    "copies, casts, concatenation": r"copy|\bcat\b|catbackward|stack|clone|contiguous|fill_|zero_",
}
REST = "other operations"
OUTSIDE = "outside of operations (Python, dispatch)"


def kind_of(operation: str) -> str:
    """The kind of operation that a profiler's name stands for."""
    for kind, pattern in KINDS.items():
        if re.search(pattern, operation, re.IGNORECASE):
            return kind
    return REST


def profile(call: Callable[[], object], title: str, device: str) -> Table:
    """Profile one call.

    Args:
        call: has run before, so that nothing is set up within it, and is no replay of a graph,
            whose operations have no names.
        title: of the table.
        device: that it computes on.

    Returns:
        Shares of the wall-clock time by kind, greatest first, with the costliest operations.
    """
    activities = [ProfilerActivity.CPU]
    on_device = torch.device(device).type == "cuda"
    if on_device:
        activities.append(ProfilerActivity.CUDA)
    with torch_profile(activities=activities) as profiler:
        start = time.perf_counter()
        call()
        if on_device:
            torch.cuda.synchronize()
        wall = time.perf_counter() - start
    spent: dict[str, dict[str, float]] = defaultdict(dict)
    for event in profiler.key_averages():
        if event.device_type.name != "CPU":
            continue  # a kernel, whose time is that of the operation which asked for it, too
        micro = event.self_device_time_total if on_device else event.self_cpu_time_total
        name = re.sub(r"^(aten|autograd::engine)::|evaluate_function: ", "", event.key)
        operations = spent[kind_of(name)]
        operations[name] = operations.get(name, 0.0) + micro / 1e6
    inside = sum(sum(operations.values()) for operations in spent.values())
    spent[OUTSIDE] = {"": max(wall - inside, 0.0)}
    lines = []
    for kind, operations in sorted(spent.items(), key=lambda entry: -sum(entry[1].values())):
        seconds = sum(operations.values())
        top = sorted(operations.items(), key=lambda entry: -entry[1])[:3]
        names = ", ".join(
            f"{name.removeprefix('aten::')} {s / wall:.0%}" for name, s in top if name
        )
        lines.append([kind, f"{seconds / wall:.1%}", f"{1e3 * seconds:.1f}", names])
    return Table(title, ["kind", "share", "ms", "costliest"], lines)

"""How much memory a process takes."""

from __future__ import annotations

import resource
import sys
from pathlib import Path

STATUS = Path("/proc/self/status")


def peak_memory() -> int:
    """Returns the most bytes of memory that this process has had at any time."""
    if STATUS.exists():  # Linux passes ru_maxrss on to the programs that a process starts
        lines = (line.split() for line in STATUS.read_text().splitlines())
        return 1024 * next(int(line[1]) for line in lines if line[0] == "VmHWM:")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # macOS counts bytes, every other system kibibytes.
    return peak if sys.platform == "darwin" else 1024 * peak

"""Commands: from a command line to a run, and from runs to what is read of them.

Importing this package, which every command does first, sets how PyTorch's threads wait, and that
memory which was used once is kept for what comes next.
"""

import ctypes
import os
import sys

# Threads that wait for each other spin, for milliseconds by default. Two programs on the same cores
# then spin through each other's turns: one training beside another PyTorch program fell from 3,660
# to 85 frames per second. It is read when PyTorch is loaded; processes that are started inherit it.
if not {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"} & os.environ.keys():
    os.environ["GOMP_SPINCOUNT"] = "1000"

# On a CPU PyTorch asks the C library for every tensor. That gives what is large back to the system,
# which then clears each page again: an eighth of the time of training on the view maze.
KEEP = {-3: 2**26, -1: 2**31 - 1}  # M_MMAP_THRESHOLD and M_TRIM_THRESHOLD of malloc.h, in bytes
if sys.platform == "linux" and not any(name.startswith("MALLOC_") for name in os.environ):
    set_allocator = getattr(ctypes.CDLL(None), "mallopt", None)  # only glibc has it
    for number, value in KEEP.items() if set_allocator is not None else ():
        set_allocator(number, value)

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
# which then clears each page again: an eighth of the time of training on the view maze. These are
# M_MMAP_THRESHOLD and M_TRIM_THRESHOLD of glibc's malloc.h, in bytes.
KEPT = {"MALLOC_MMAP_THRESHOLD_": (-3, 2**26), "MALLOC_TRIM_THRESHOLD_": (-1, 2**31 - 1)}
if sys.platform == "linux" and not {*KEPT, "GLIBC_TUNABLES"} & os.environ.keys():
    c_library = ctypes.CDLL(None)
    for option, value in KEPT.values() if hasattr(c_library, "mallopt") else ():  # glibc's alone
        c_library.mallopt(option, value)

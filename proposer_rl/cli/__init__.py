"""The commands of ``bin/``: they train, and they read runs.

Every command imports this package first. It sets how PyTorch's threads wait for each other, and
that freed memory is kept for reuse.
"""

import ctypes
import os
import sys

# Waiting threads spin, for milliseconds by default, and two programs on the same cores take each
# other's time in that way: training beside another PyTorch program fell from 3,660 to 85 frames per
# second. PyTorch reads the variable when it is loaded; child processes inherit it.
if not {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"} & os.environ.keys():
    os.environ["GOMP_SPINCOUNT"] = "1000"

# On a CPU PyTorch allocates each tensor from the C library, which returns large blocks to the
# system. The system must then clear their pages again, which takes an eighth of the time of
# training on the view maze. These are M_MMAP_THRESHOLD and M_TRIM_THRESHOLD of glibc's malloc.h, in
# bytes.
KEPT = {"MALLOC_MMAP_THRESHOLD_": (-3, 2**26), "MALLOC_TRIM_THRESHOLD_": (-1, 2**31 - 1)}
if sys.platform == "linux" and not {*KEPT, "GLIBC_TUNABLES"} & os.environ.keys():
    c_library = ctypes.CDLL(None)
    for option, value in KEPT.values() if hasattr(c_library, "mallopt") else ():  # glibc's alone
        c_library.mallopt(option, value)

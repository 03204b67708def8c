"""Commands: from a command line to a run, and from runs to what is read of them.

Importing this package, which every command does first, sets how PyTorch's threads wait.
"""

import os

# Threads that wait for each other spin, for milliseconds by default. Two programs on the same cores
# then spin through each other's turns: one training beside another PyTorch program fell from 3,660
# to 85 frames per second. It is read when PyTorch is loaded; processes that are started inherit it.
if not {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"} & os.environ.keys():
    os.environ["GOMP_SPINCOUNT"] = "1000"

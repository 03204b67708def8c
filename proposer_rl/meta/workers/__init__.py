"""The K copies of a cycle in several processes, on one machine or many, with TorchRL's collectors.

A worker holds and trains its own copies. Every random number belongs to a copy's number, so that a
copy's results are the same wherever it is computed, but for rounding.
"""

from proposer_rl.meta.workers.copies import CopiesInWorkers, shares
from proposer_rl.meta.workers.engines import WorkersError, WorkerSettings

__all__ = ["CopiesInWorkers", "WorkerSettings", "WorkersError", "shares"]

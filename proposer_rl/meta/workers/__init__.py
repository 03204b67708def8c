"""The K copies of a cycle in several processes, on one machine or many, with TorchRL's collectors.

A worker holds all K copies but computes only its share of them: every stack has the same shape
everywhere, and every random number belongs to a copy's number, so that a copy's results do not
depend on where it is computed, bit for bit on processors of one kind.
"""

from proposer_rl.meta.workers.copies import CopiesInWorkers, shares
from proposer_rl.meta.workers.engines import WorkersError, WorkerSettings

__all__ = ["CopiesInWorkers", "WorkerSettings", "WorkersError", "shares"]

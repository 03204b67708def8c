"""The K replicas of a cycle in several processes, on one machine or many, by TorchRL's collectors.

A worker holds and trains its own replicas. Every random number belongs to a replica's number, so
that its results are the same wherever it is computed, but for rounding.
"""

from proposer_rl.meta.workers.copies import CopiesInWorkers, shares
from proposer_rl.meta.workers.engines import WorkersError, WorkerSettings
from proposer_rl.meta.workers.remote import worker_env

__all__ = ["CopiesInWorkers", "WorkerSettings", "WorkersError", "shares", "worker_env"]

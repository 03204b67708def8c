"""Run folders, checkpoints, and the process of a run."""

"""Environments of one's own that step all levels of a batch at once, as tasks."""

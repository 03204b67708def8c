"""Measurements of speed and memory, each against something timed beside it in the same run.

``bin/bench`` runs them; ``docs/benchmark.md`` says what they mean.
"""

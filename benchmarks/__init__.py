"""Measurements of speed and memory, each against something timed beside it in the same run.

``bin/bench`` and ``proposer-bench`` run them; ``docs/benchmark.md`` says what they mean.
"""

"""Measurements of speed and memory, where they can be against something timed beside them.

``bin/bench`` runs them; ``docs/explanation/performance.md`` says what they mean.
"""

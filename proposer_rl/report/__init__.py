"""Compares runs: statistics, tables, figures, a page, and studies to publish."""

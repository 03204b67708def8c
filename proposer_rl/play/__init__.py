"""Serves a local page to draw levels and to watch a run's Solvers on them."""

"""A local page on which levels are drawn and a run's Solvers are watched on them."""

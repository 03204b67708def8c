"""The paper's method: a Proposer learns in an environment whose steps train a Solver."""

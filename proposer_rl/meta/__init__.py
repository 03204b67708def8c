"""The paper's method: training a Solver as an environment, in which a Proposer acts and learns."""

"""Any Gymnasium environment as a task, in which settings make a level."""

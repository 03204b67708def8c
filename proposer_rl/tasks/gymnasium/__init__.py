"""Any Gymnasium environment as a task: what is set in it makes a level."""

"""What a run leaves behind, and how it survives what may happen to it."""

"""The partially observable maze: levels with a direction, an agent that sees 5x5 cells."""

"""The field's maze: levels with a direction, and an agent that sees 5x5 cells of them."""

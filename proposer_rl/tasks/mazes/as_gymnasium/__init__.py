"""The maze as Gymnasium environments, one at a time or many at once."""

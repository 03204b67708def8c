"""Small environments of many kinds, on which curricula are compared."""

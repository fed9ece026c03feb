"""Training and comparing the variants of a detector: rows, runs and their table."""

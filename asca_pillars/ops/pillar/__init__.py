"""Pillars: the adaptive-scale grid, pillarize, and the rulebooks of a sparse neck."""

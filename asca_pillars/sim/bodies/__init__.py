"""Shapes of vehicles, people and background objects."""

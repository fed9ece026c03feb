"""Sensor model: the measurement of each hit."""

"""Geometry computed identically in training and on the vehicle: NumPy, and numba for the loops of NMS."""

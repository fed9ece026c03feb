"""Geometry that training and the vehicle must compute identically: NumPy, and numba for the loops of NMS."""

"""Point operations: farthest points, ball queries, interpolation."""

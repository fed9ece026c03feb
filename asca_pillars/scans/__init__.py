"""Scan files of every format, read as points (N, 4)."""

"""Readers of scan files and recordings of all formats, as points (N, 4)."""

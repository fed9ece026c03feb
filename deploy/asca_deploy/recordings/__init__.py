"""Recordings: detection scan by scan, and the files that are written of it."""

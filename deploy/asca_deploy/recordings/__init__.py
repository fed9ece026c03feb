"""Recordings: detection scan by scan, and the files with its results."""

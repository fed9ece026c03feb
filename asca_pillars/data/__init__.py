"""Labelled frames, their augmentation, and the files they come from."""

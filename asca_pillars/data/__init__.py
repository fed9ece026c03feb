"""Labelled frames, their augmentation, and the readers and writers of their files."""

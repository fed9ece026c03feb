"""Labelled boxes in the LiDAR frame, without a camera."""

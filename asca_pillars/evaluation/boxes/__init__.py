"""Detection metrics of boxes in the LiDAR frame, for any class and without a camera."""

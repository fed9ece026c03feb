"""LiDAR 3D detection with adaptive-scale pillars: ASCA-PointPillars, from the scan to the boxes."""

__version__ = "0.1.0"

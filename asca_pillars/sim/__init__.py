"""Simulated street scans with labels in KITTI's layout."""

"""KITTI's official protocol: average precision and orientation similarity."""

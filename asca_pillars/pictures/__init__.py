"""Pictures of scans and boxes: bird's-eye and camera."""

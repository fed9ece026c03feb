"""Anchors, target assignment, decoding with NMS, and the detections of a scan, in NumPy."""

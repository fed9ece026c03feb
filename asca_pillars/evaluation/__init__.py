"""Evaluation of detections against labels."""

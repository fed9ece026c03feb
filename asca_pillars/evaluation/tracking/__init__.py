"""Evaluation of tracking: HOTA and CLEAR MOT."""

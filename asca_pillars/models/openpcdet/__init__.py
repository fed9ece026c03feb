"""Weights that OpenPCDet trained, as checkpoints of ours."""

"""Weights that OpenPCDet or mmdetection3d trained, as checkpoints of ours."""

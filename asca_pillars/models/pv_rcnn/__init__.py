"""PV-RCNN in PyTorch: voxels and keypoints, both stages trained together."""

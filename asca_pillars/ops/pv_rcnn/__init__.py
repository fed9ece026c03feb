"""Voxels, their rulebooks and the scan as PV-RCNN's network reads it."""

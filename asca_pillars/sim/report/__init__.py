"""Realism report: statistics of any KITTI-layout folder, compared with those of KITTI."""

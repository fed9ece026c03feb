"""How like real scans a data set is: measured from any KITTI-layout folder and compared with KITTI's own statistics."""

"""Host geometry of the second stage (PV-RCNN, arXiv 1912.13192).

In the order of the data: `run_first_stage` -> `farthest_points` (keypoints) -> `read_map` (the first stage's map at the
keypoints) -> `roi_grid_points` -> `ball_query` (neighbors) -> (the network) -> `decode_refinement`; `roi_targets` for
training.
"""

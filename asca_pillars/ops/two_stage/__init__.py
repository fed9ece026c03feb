"""Host geometry of the second stage (PV-RCNN, arXiv 1912.13192), in NumPy alone.

In the order of the data: `proposals` -> `farthest_points` (keypoints) -> `ball_query` (who aggregates what) ->
`bilinear` (the first stage's map at the keypoints) -> `roi_grid` -> (the network) -> `refinement`; `roi_targets` for
training. Where numba is installed it runs the loops, with the same results (`base.kernels`).
"""

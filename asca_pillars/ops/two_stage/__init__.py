"""Host geometry of the second stage (PV-RCNN, arXiv 1912.13192).

In the order of the data: `proposals` -> `farthest_points` (keypoints) -> `ball_query` (neighbors) ->
`bilinear` (the first stage's map at the keypoints) -> `roi_grid` -> (the network) -> `decode`; `roi_targets` for
training.
"""

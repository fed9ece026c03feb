"""What training and the vehicle must compute identically, in NumPy alone.

Where numba is installed it runs the loops of `pillarize` and `rotated_nms` (`compiled`), with the same results.

In the order of the data: `grid` -> `pillarize` -> (the network) -> `anchors` -> `decode` -> `detections`.
`boxes` draws the conventions, `overlap` holds IoU and NMS, and `spec` ties one detector's numbers together.
Import from the modules themselves: `pillarize` and `decode` are modules as well as functions.
"""

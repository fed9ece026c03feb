"""What training and the vehicle must compute identically, in NumPy alone.

Where numba is installed it runs the loops of `rotated_nms` (`nms_kernels`), with the same results.

In the order of the data: (the network) -> `anchors` -> `decode` with NMS -> `detections`. `boxes` draws the
conventions, `overlap` holds IoU, and `detector_spec` ties one detector's numbers together. Import from the modules
themselves: `decode` is a module as well as a function.
"""

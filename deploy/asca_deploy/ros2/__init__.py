"""`asca ros2`: a node that answers a topic of point clouds with boxes."""

"""ROS 2 node of `asca ros2`: publishes boxes for a topic of point clouds."""

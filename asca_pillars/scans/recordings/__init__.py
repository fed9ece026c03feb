"""Recordings of drives: MCAP, rosbag2 and ROS 1 bags, read as scans with time stamps."""

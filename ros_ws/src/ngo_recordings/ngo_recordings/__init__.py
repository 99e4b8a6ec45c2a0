"""Recordings of a robot: MCAP is written; MCAP, rosbag2, ROS 1 bags and CARMEN logs are read, without ROS."""

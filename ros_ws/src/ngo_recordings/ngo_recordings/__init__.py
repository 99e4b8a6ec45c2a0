"""Recordings of a robot: written as MCAP, read from MCAP and rosbag2. Nothing here needs ROS."""

"""Simulated maze worlds with exact ground truth, and the drivers that explore them. Nothing here needs ROS."""

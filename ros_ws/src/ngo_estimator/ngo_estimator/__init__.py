"""Learned pose estimation: local odometry and the Neural Graph Optimizer."""

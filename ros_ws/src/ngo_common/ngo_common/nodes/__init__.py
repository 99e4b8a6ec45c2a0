"""The ROS side of what nodes share: parameters, quality of service, and the process around a node."""

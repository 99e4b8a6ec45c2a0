"""ROS 2 nodes around the estimators: parameters, conversion, one call into the core, publishing."""

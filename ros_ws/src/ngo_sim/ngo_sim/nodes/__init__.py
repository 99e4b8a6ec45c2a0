"""ROS 2 nodes around the simulators: parameters, conversion, one call into the core, publishing."""

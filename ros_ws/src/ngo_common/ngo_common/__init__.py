"""The parts that the nodes of several packages share: settings, and below `nodes` their ROS side."""

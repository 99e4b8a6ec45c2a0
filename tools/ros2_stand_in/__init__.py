"""A stand-in for the part of the `ros2` command that this project's documentation uses."""

"""Exploration: where a robot drives next, so that it maps a place fast. The core knows no ROS."""

"""Whole recordings through both estimators, without ROS."""

"""Shared by all trainings: runs, learning curves, precision, losses of steps, command line."""

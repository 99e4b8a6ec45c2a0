"""Offline training: data from the simulators, one script a network, evaluation."""

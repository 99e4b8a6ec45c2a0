"""Files, errors, reports and plots of trajectories."""

"""Training data from the simulators: worlds, streams, feature stores."""

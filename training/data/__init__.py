"""Training data: worlds, episodes, streams, feature stores."""

"""The learned networks: local pose, place encoder, aggregation, smoothing."""

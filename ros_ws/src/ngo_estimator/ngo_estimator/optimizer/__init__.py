"""The optimizer of the pose graph, and the loops that it takes."""

"""Geometry of poses, of scans and of graphs: pure functions on arrays."""

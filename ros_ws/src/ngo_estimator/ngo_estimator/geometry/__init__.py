"""Planar geometry: poses, covariances, registration of range scans."""

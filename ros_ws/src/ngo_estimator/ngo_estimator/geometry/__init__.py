"""Planar geometry: poses, covariances, registration of range scans. Of the paper there are r2g and g2r (``se2``)."""

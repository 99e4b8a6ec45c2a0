"""From relative poses to the corrected trajectory, while they arrive."""

"""From ranges at corrected poses to an occupancy grid, and its files."""

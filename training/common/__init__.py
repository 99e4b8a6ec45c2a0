"""What every training shares: runs, learning curves, data modules."""

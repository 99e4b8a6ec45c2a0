"""A robot's recordings: stores, streams, reports and pictures."""

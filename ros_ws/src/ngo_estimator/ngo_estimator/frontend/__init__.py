"""From frames to relative poses."""

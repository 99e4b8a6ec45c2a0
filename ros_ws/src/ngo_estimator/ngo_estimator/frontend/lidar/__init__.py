"""From scans and wheels to relative poses, by registration."""

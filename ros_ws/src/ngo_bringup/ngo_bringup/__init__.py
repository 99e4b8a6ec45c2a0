"""What the launch files of the whole graph have in common."""

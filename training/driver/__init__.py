"""The learned driver of the 3D world."""

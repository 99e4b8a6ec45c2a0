"""What a live view shows, and the view that rerun serves to browsers."""

"""The node that explores."""

"""From images and actions to relative poses, by networks."""

"""References of the ground, and how one image is found on another."""

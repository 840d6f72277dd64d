"""References of the ground, how one image is found on another, and water: drawn, and measured."""

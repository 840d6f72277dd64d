"""Components of terrain-relative navigation: a model plus ports, state and a rate."""

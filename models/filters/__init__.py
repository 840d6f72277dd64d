"""Navigation filters: states, propagation, updates, and whether they are consistent."""

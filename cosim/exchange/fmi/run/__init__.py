"""Anybody's FMU as a component: read, bound, stepped here or in another process."""

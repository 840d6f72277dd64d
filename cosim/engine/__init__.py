"""The master that steps a system, the simulation around it, and one run to its file."""

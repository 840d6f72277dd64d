"""How bodies move: gravity, orbits, attitude, and where an orbit starts."""

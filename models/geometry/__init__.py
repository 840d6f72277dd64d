"""Where things are and how they are turned: the Earth, frames, rotations, antennas."""

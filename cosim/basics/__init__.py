"""What all else stands on: errors, exact time, units, noise, arrays, files and the machine."""

"""System files: a reader for each suffix, and the writer."""

"""What really happens: orbit, attitude and terrain, computed or recorded."""

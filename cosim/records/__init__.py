"""What a run leaves: records, results, checkpoints, and the places that keep them."""

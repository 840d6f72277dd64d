"""What sensors measure, with their errors."""

"""What every model is made of: the symbolic model, members, arrays and their arithmetic."""

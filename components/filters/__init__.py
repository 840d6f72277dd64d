"""Who estimates: filters, and what they start from."""

"""Recorded raw echo in the formats that it comes in, read to one interface."""

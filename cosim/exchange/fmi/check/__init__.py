"""Checks of anybody's FMU."""

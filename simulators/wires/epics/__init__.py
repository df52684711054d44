"""A simulated motor record."""

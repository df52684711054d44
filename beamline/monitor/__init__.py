"""Monitor: checks every frame while it can still be repeated."""

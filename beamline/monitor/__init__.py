"""Monitor: checks that look at every frame while it can still be repeated."""

"""What a frame of a scene costs."""

"""Speed and quality of a standard case on this machine."""

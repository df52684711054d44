"""Effects: one departure from Beer-Lambert a file; a scene computes only those that it names."""

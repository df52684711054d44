"""Trade-off: many reconstructions of one scan, compared by quality, time and memory."""

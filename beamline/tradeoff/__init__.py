"""Trade-off: many reconstructions of one scan, and what quality costs in time and memory."""

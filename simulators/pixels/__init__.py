"""Random numbers, fixed patterns and wide blurs of frames, used by effects."""

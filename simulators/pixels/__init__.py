"""Pixels: random numbers, fixed patterns and wide blurs over a frame, for effects to build on."""

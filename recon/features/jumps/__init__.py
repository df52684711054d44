"""Jumps of the sample: in which of them it moved, and the views that show it."""

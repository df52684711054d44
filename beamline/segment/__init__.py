"""Segmentation of a volume file into particles: labels, a table of sizes and places, and a picture."""

"""Removal of stripes in sinograms, which make rings in slices."""

STEPS = {"Rings": "rings.rings"}

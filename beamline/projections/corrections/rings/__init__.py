"""Stripes of the sinograms, which make rings, removed."""

STEPS = {"Rings": "rings.rings"}

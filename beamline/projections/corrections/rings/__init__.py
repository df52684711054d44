"""Stripes of the sinograms, which make rings, removed."""

from __future__ import annotations

STEPS = {"Rings": "rings.rings"}

"""Rings: stripes that unequal pixels make in sinograms, seen and removed."""

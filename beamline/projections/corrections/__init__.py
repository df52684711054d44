"""Corrections of projections, one per file; `registry` has a line for each."""

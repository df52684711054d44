"""Projections: converts the frames of a scan to line integrals."""

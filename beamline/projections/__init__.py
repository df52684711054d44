"""Projections: frames of a scan become line integrals."""

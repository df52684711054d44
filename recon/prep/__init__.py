"""Preparation of projections: counts to line integrals, and the rotation axis."""

"""Before a reconstruction: counts to line integrals, and the rotation axis."""

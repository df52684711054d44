"""Absorption over energies: the edge of a material, and the energy of its highest contrast."""

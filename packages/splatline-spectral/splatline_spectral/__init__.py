"""Absorption over energies: edges, the energy of a material's highest contrast, and volumes of materials."""

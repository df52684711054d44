"""Scans at several energies: absorption edges, the energy of the best contrast, and a volume for each material."""

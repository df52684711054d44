"""Neural fields: a volume as a network of the coordinates, fitted to line integrals along sampled rays."""

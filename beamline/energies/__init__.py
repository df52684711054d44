"""Scans of one sample at several energies as one source of views."""

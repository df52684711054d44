"""Readers: scans of any format behind one Protocol."""

"""Readers: one interface for scan files of all formats."""

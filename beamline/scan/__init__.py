"""Scan: runs one scan, from the checks before it to the closed file."""

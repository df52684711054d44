"""Scan: one scan from preflight to the closed file."""

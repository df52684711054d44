"""Simulate: a scene becomes a scan file with labels and truth, without an instrument."""

"""Simulated Tsuji PM16C-04XD."""

"""Tsuji PM16C-04XD pulse-motor controller."""

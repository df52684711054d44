"""Figures of merit that trials of methods compare."""

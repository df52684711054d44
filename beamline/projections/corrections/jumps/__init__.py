"""Handles projections that were taken after the sample moved on its stage."""

STEPS = {"Jumps": "jumps.jumps"}

"""Projections after the sample moved on its stage."""

STEPS = {"Jumps": "jumps.jumps"}

"""Phase retrieved from one distance."""

STEPS = {"Phase": "phase.phase"}

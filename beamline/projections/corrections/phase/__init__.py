"""Phase retrieval from one distance."""

STEPS = {"Phase": "phase.phase"}

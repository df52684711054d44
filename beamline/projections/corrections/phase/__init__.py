"""Phase retrieved from one distance."""

from __future__ import annotations

STEPS = {"Phase": "phase.phase"}

"""Views after the sample moved on its stage."""

from __future__ import annotations

STEPS = {"Jumps": "jumps.jumps"}

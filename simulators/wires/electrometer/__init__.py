"""Simulated electrometer."""

from __future__ import annotations

BEAM_MONITORS = {"electrometer": f"{__name__}.wire"}

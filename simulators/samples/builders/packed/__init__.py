"""Builders of packed bodies and patterns: cathodes, foams and resolution patterns."""

from __future__ import annotations

PHANTOMS = dict.fromkeys(("cathode", "foam", "resolution"), f"{__name__}.pieces")

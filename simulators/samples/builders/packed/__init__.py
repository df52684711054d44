"""Builders of packed bodies and patterns: cathodes, foams and resolution patterns."""

PHANTOMS = dict.fromkeys(("cathode", "foam", "resolution"), f"{__name__}.pieces")

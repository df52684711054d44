"""Builders of packed bodies: cathodes and foams."""

PHANTOMS = dict.fromkeys(("cathode", "foam"), f"{__name__}.pieces")

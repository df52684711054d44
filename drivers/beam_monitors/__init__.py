"""Beam monitors: read over a serial line or from a web page."""

"""Particles: segments the particles of a volume, and measures them."""

COMMANDS = {
    "segment": ("Segment the particles of a volume: labels, sizes, places.", True),
}

"""Particles: segments the particles of a volume, and measures them."""

from __future__ import annotations

from beamline.cli.commands import CommandEntry, Libraries

COMMANDS = {
    "segment": CommandEntry(
        "beamline.features.particles.command",
        "Segment the particles of a volume: labels, sizes, places.",
        Libraries.FILES,
    ),
}

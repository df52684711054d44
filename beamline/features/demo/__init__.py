"""Demonstration: a simulated scan with live reconstruction, compared with the truth."""

from __future__ import annotations

from beamline.cli.commands import CommandEntry, Libraries

COMMANDS = {
    "demo": CommandEntry(
        "beamline.features.demo.command",
        "Run a simulated scan with live reconstruction; writes a volume and a report.",
        Libraries.FITS,
    ),
}

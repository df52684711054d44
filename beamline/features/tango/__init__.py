"""Tango: the running scan as a Tango device."""

from __future__ import annotations

from beamline.cli.commands import CommandEntry, Libraries

COMMANDS = {
    "tango": CommandEntry(
        "beamline.features.tango.command", "Serve the running scan as a Tango device.", Libraries.NONE, files=False
    ),
}

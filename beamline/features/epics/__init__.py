"""EPICS: the running scan as process variables."""

from __future__ import annotations

from beamline.cli.commands import CommandEntry, Libraries

COMMANDS = {
    "ioc": CommandEntry(
        "beamline.features.epics.command",
        "Serve the running scan as EPICS process variables.",
        Libraries.NONE,
        files=False,
    ),
}

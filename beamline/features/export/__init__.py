"""Volumes in other formats, and films of volumes and views."""

from __future__ import annotations

from beamline.cli.commands import CommandEntry, Libraries

COMMANDS = {
    "export": CommandEntry(
        "beamline.features.export.command",
        "Copy a volume to another format, with grey values if wanted, or make a film of it.",
        Libraries.FILES,
    ),
}

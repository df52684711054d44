"""Checks of this computer: its devices, disk and memory."""

from __future__ import annotations

from beamline.cli.commands import CommandEntry

COMMANDS = {
    "doctor": CommandEntry(
        "beamline.features.doctor.command",
        "Check this computer: camera link, ports, disk, memory. Nothing moves.",
        files=False,
    ),
}

"""Archives: compressed copies of scan files, compared with them frame by frame."""

from __future__ import annotations

from beamline.cli.commands import CommandEntry, Libraries

COMMANDS = {
    "archive": CommandEntry(
        "beamline.features.archive.command",
        "Write a compressed copy of a scan file, compared with it frame by frame.",
        Libraries.FILES,
    ),
}

"""Completion of commands and options in a shell."""

from __future__ import annotations

from beamline.cli.commands import CommandEntry, Libraries

COMMANDS = {
    "completion": CommandEntry(
        "beamline.features.completion.command",
        "Print the completion script of a shell.",
        Libraries.NONE,
        files=False,
    ),
}

"""The shell: manual pages, and completion of commands and options."""

from __future__ import annotations

from beamline.cli.commands import CommandEntry, Libraries

COMMANDS = {
    "completion": CommandEntry(
        "beamline.features.completion.command",
        "Print the completion script of a shell.",
        Libraries.NONE,
        files=False,
    ),
    "man": CommandEntry(
        "beamline.features.completion.command",
        "Print the manual page of a command.",
        Libraries.NONE,
        files=False,
    ),
}

"""Commands by name: the core's, those of features, and those of other packages (entry points `splatline.command`).

The help lists them without importing the modules that run them, and their libraries.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import import_module

import click

from recon.base.registry import Registry, tables_in_folders


@dataclass(frozen=True)
class CommandEntry:
    """A command: the module that defines it, and its one-line help.

    Attributes:
        module: in which the command has its own name, "-" as "_".
        files: its results are files or moves; its output is only a summary.
        command: of another package, which is loaded.
    """

    module: str
    help: str
    files: bool = True
    command: click.Command | None = None

    def load(self, name: str) -> click.Command:
        if self.command is not None:
            return self.command
        command: click.Command = getattr(import_module(self.module), name.replace("-", "_"))
        return command


CORE = {
    "check": CommandEntry("beamline.cli.control", "Validate a configuration. Nothing moves.", files=False),
    "home": CommandEntry("beamline.cli.control", "Search the stage's reference position. The stage turns."),
    "scan": CommandEntry("beamline.cli.scan", "Run a scan, or print its plan with --dry-run."),
    "pause": CommandEntry("beamline.cli.control", "Pause a running scan, from another terminal: no view is lost."),
    "resume": CommandEntry("beamline.cli.control", "Let a paused scan go on."),
    "stop": CommandEntry("beamline.cli.control", "Stop a running scan cleanly, from another terminal."),
    "abort": CommandEntry("beamline.cli.control", "Abort a running scan at once, from another terminal."),
    "recon": CommandEntry("beamline.cli.recon", "Reconstruct a scan, finished or still running."),
    "recover": CommandEntry("beamline.cli.control", "Make an ordinary scan file of one whose writer died."),
    "monitor": CommandEntry(
        "beamline.cli.monitor", "Look at the frames of a scan file with the checks of the monitor.", files=False
    ),
    "config": CommandEntry(
        "beamline.cli.control", "Print a configuration template, a complete configuration, or the schema.", files=False
    ),
}
"""What acquires, watches and reconstructs, in the order of the help."""


@cache
def feature_commands() -> dict[str, CommandEntry]:
    """The commands of the folders in `beamline.features`, in the order of the folders' names.

    COMMANDS of a folder has the help line and `CommandEntry.files` of each; it is in the folder's module `command`.
    """
    return {
        name: CommandEntry(f"beamline.features.{folder}.command", help_line, files)
        for folder, rows in tables_in_folders("beamline.features", "COMMANDS").items()
        for name, (help_line, files) in rows.items()
    }


def own_commands() -> dict[str, CommandEntry]:
    """All commands of this package, the core's first."""
    return {**CORE, **feature_commands()}


@cache
def commands() -> Registry[CommandEntry]:
    """All commands. Other packages are searched only for names that this package lacks."""
    return Registry("command", own_commands(), _entry_of)


def _entry_of(name: str, command: object) -> CommandEntry:
    """The entry of a command of another package."""
    if not isinstance(command, click.Command):
        raise ValueError(f"it is a {type(command).__name__}; expected a click.Command")
    return CommandEntry("", command.get_short_help_str(100), command=command)

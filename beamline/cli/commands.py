"""Commands by name: the core's, those of features, and those of other packages (entry points `splatline.command`).

The help lists them without importing the modules that run them, and their libraries.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cache
from importlib import import_module

import click

from recon.base.registry import Registry, tables_in_folders


class Libraries(Enum):
    """Address space that the libraries of a command need, and modules to import before its data are read.

    Attributes:
        addresses: bytes that a command on a tiny scan takes at its peak, with one thread of BLAS, and a twentieth more;
            measured on Linux with two cores.
        early: modules that are otherwise loaded late, when data have taken the room.
    """

    NONE = (0, ())
    FILES = (800_000_000, ("scipy.linalg",))
    FRAMES = (1_350_000_000, ("scipy.linalg", "scipy.ndimage"))
    FITS = (1_850_000_000, ("scipy.linalg", "torch", "matplotlib.figure"))

    def __init__(self, addresses: int, early: tuple[str, ...]) -> None:
        self.addresses, self.early = addresses, early


@dataclass(frozen=True)
class CommandEntry:
    """A command: the module that defines it, and its one-line help.

    Attributes:
        module: in which the command has its own name, "-" as "_".
        libraries: that it loads.
        files: its results are files or moves; its output is only a summary.
        command: of another package, which is loaded.
    """

    module: str
    help: str
    libraries: Libraries = Libraries.NONE
    files: bool = True
    command: click.Command | None = None

    def load(self, name: str) -> click.Command:
        if self.command is not None:
            return self.command
        command: click.Command = getattr(import_module(self.module), name.replace("-", "_"))
        return command


def _core(module: str, help_line: str, libraries: Libraries = Libraries.NONE, *, files: bool = True) -> CommandEntry:
    return CommandEntry(f"beamline.cli.{module}", help_line, libraries, files)


CORE = {
    "check": _core("control", "Validate a configuration. Nothing moves.", files=False),
    "home": _core("control", "Search the stage's reference position. The stage turns."),
    "scan": _core("scan", "Run a scan, or print its plan with --dry-run.", Libraries.FRAMES),
    "pause": _core("control", "Pause a running scan, from another terminal: no view is lost."),
    "resume": _core("control", "Let a paused scan go on."),
    "stop": _core("control", "Stop a running scan cleanly, from another terminal."),
    "abort": _core("control", "Abort a running scan at once, from another terminal."),
    "recon": _core("recon", "Reconstruct a scan, finished or still running.", Libraries.FITS),
    "recover": _core("control", "Make an ordinary scan file of one whose writer died."),
    "monitor": _core(
        "monitor", "Look at the frames of a scan file with the checks of the monitor.", Libraries.FRAMES, files=False
    ),
    "config": _core("control", "Print a configuration template, a complete configuration, or the schema.", files=False),
}
"""What acquires, watches and reconstructs, in the order of the help."""


@cache
def feature_commands() -> dict[str, CommandEntry]:
    """The commands of the folders in `beamline.features`, in the order of the folders' names.

    COMMANDS of a folder has the help line, the name in `Libraries`, and perhaps `CommandEntry.files` of each; it is in
    the folder's module `command`.
    """
    return {
        name: CommandEntry(f"beamline.features.{folder}.command", help_line, Libraries[libraries], *files)
        for folder, rows in tables_in_folders("beamline.features", "COMMANDS").items()
        for name, (help_line, libraries, *files) in rows.items()
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

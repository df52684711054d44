"""Sweeps: any option of a reconstruction over a range, as a sheet of the same slice, with a score."""

from __future__ import annotations

from beamline.cli.commands import CommandEntry, Libraries

COMMANDS = {
    "sweep": CommandEntry(
        "beamline.features.sweeps.command",
        "Reconstruct one slice with each value of an option, as a sheet with scores.",
        Libraries.FITS,
    ),
}

"""Materials: the volume of each material, fitted to scans at several energies."""

from __future__ import annotations

from beamline.cli.commands import CommandEntry, Libraries

COMMANDS = {
    "materials": CommandEntry(
        "beamline.features.materials.command",
        "Fit the volume of each material to scans at several energies.",
        Libraries.FITS,
    ),
}

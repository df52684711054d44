"""Batches: many scans reconstructed by one recipe, with a table of what became of each."""

from __future__ import annotations

from beamline.cli.commands import CommandEntry, Libraries

COMMANDS = {
    "batch": CommandEntry(
        "beamline.features.batch.command",
        "Reconstruct many scans by one recipe; a table says what became of each.",
        Libraries.FITS,
    ),
}
COUNTED = {"batch": "scans"}

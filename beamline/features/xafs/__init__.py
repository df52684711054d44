"""X-ray absorption fine structure: absorption edges of materials, and maps of charge from scans over energies."""

from __future__ import annotations

from beamline.cli.commands import CommandEntry, Libraries

COMMANDS = {
    "xafs": CommandEntry(
        "beamline.features.xafs.command",
        "Find a material's absorption edge and the energy of its highest contrast.",
        Libraries.FILES,
    ),
}

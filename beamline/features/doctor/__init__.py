"""What this computer can do: checks of its devices, disk and memory, and measurements of its speed."""

from __future__ import annotations

from beamline.cli.commands import CommandEntry, Libraries

COMMANDS = {
    "doctor": CommandEntry(
        "beamline.features.doctor.command",
        "Check this computer: camera link, ports, disk, memory. Nothing moves.",
        files=False,
    ),
    "bench": CommandEntry(
        "beamline.features.doctor.bench",
        "Measure this machine: kernels, fits, quality against time, and acquisition.",
        Libraries.FITS,
    ),
}
COUNTED = {"bench": "runs"}

"""Before a scan: which exposure to take, and how the axis lies, by a few frames."""

from __future__ import annotations

from beamline.cli.commands import CommandEntry, Libraries

COMMANDS = {
    "tune": CommandEntry(
        "beamline.features.tuning.command", "Take a few frames and say which exposure to take.", Libraries.FRAMES
    ),
    "align": CommandEntry(
        "beamline.features.tuning.command",
        "Take a pair of views and say axis, tilt and sharpness, with the corrections.",
        Libraries.FRAMES,
    ),
}

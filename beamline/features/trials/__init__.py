"""Trials: methods and settings compared on a scan, and what fewer views would cost."""

from __future__ import annotations

from beamline.cli.commands import CommandEntry, Libraries

COMMANDS = {
    "tradeoff": CommandEntry(
        "beamline.features.trials.command",
        "Compare methods and settings on a scan: quality against time and memory.",
        Libraries.FITS,
    ),
    "study": CommandEntry(
        "beamline.features.trials.command",
        "Say what fewer views, narrower sectors, random angles or averaged views cost on a scan.",
        Libraries.FITS,
    ),
}

"""Runs and volumes in the browser: the page of a run, the list of runs, and the viewer."""

from __future__ import annotations

from beamline.cli.commands import CommandEntry, Libraries

COMMANDS = {
    "runs": CommandEntry(
        "beamline.features.page.runs", "List the runs in a folder: sample, frames, state, size, flags.", files=False
    ),
    "watch": CommandEntry(
        "beamline.features.page.watch", "Show a run in the browser while it goes on, and afterwards."
    ),
    "view": CommandEntry(
        "beamline.features.page.view",
        "Show a scan, or one or two volumes, in the browser: slices, axis, histogram, profile, difference.",
        Libraries.FILES,
    ),
}

"""Runs and volumes in the browser: the page of a run, the list of runs, and the viewer."""

COMMANDS = {
    "runs": ("List the runs in a folder: sample, frames, state, size, flags.", False),
    "watch": ("Show a run in the browser while it goes on, and afterwards.", True),
    "view": ("Show a scan, or one or two volumes, in the browser: slices, axis, histogram, profile, difference.", True),
}

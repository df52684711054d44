"""Pages in the browser: the page of a run, the list of runs, and the viewer of scans and volumes."""

COMMANDS = {
    "runs": ("List the runs in a folder: sample, frames, state, size, flags.", False),
    "watch": ("Show a run in the browser, during the scan and afterwards.", True),
    "view": ("Show a scan, or one or two volumes, in the browser: slices, profiles, histograms, difference.", True),
}

"""Files of scans and volumes: what they hold, what is wrong with them, and a copy of any scan in our own layout."""

from __future__ import annotations

from beamline.cli.commands import CommandEntry, Libraries

_MODULE = "beamline.features.files.command"

COMMANDS = {
    "info": CommandEntry(_MODULE, "Describe a scan file or a volume.", Libraries.FILES, files=False),
    "validate": CommandEntry(
        _MODULE, "Check a scan file or a volume against the rules of its format.", Libraries.FILES, files=False
    ),
    "ingest": CommandEntry(_MODULE, "Copy any scan into one HDF5 scan, frame by frame.", Libraries.FILES),
}

"""Files of scans and volumes: what they hold, what is wrong with them, and a copy of any scan in our own layout."""

COMMANDS = {
    "info": ("Describe a scan file or a volume.", False),
    "validate": ("Check whether a scan file can be reconstructed, or whether a volume is sound.", False),
    "ingest": ("Copy any scan into one HDF5 scan, frame by frame.", True),
}

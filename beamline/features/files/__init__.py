"""Files of scans and volumes: describe them, find errors in them, and copy any scan into our own HDF5 layout."""

COMMANDS = {
    "info": ("Describe the contents of a scan file or of a volume.", False),
    "validate": ("Check whether a scan file can be reconstructed, or whether a volume file is intact.", False),
    "ingest": ("Convert a scan of any format into one HDF5 file.", True),
}

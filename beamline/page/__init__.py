"""The page on which a scan is watched: a process of its own that reads the scan file and the log of events."""

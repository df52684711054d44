"""The web page on which a scan is watched: a separate process that reads the scan file and the log of events."""

"""The web page that shows a scan. A separate process serves it, and reads the scan file and the log of events."""

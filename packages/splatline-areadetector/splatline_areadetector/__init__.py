"""EPICS areaDetector: record the scan of another program, serve a scan of ours to other programs, drive a camera."""

"""EPICS areaDetector: records the scan of another program, publishes a scan of this program to other programs, and
drives a camera."""

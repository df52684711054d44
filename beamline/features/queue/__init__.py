"""Several scans, taken one after the other by `beamline scan`."""

QUEUES = {"scan": f"{__name__}.scans"}
"""Command -> the module that takes its queue."""

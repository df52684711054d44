"""Queue: `beamline scan` runs several scans one after the other."""

QUEUES = {"scan": f"{__name__}.scans"}
"""Command -> the module that takes its queue."""

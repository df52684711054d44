"""Queue: `beamline scan` runs several scans one after the other."""

QUEUES = {"scan": f"{__name__}.scans"}
"""For each command, the module that runs its queue."""

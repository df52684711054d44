"""Several scans, taken one after the other by `beamline scan`."""

from __future__ import annotations

QUEUES = {"scan": f"{__name__}.scans"}
"""Command -> the module that takes its queue."""

"""Several volumes that all views determine together: at times of a scan of a sample that changes, or of materials."""

from __future__ import annotations

from recon.base.registry import MethodEntry

METHODS = {
    "series": MethodEntry("recon.features.joint.methods", "TimeSeries", compared=False, several="times"),
    "materials": MethodEntry("recon.features.joint.methods", "EnergySeries", compared=False, several="materials"),
}

"""Joint reconstruction of several volumes from all projections: a sample at several times, or one per material."""

from recon.base.registry import MethodEntry

METHODS = {
    "series": MethodEntry("recon.features.joint.methods", "TimeSeries", compared=False, several="times"),
}

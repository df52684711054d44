"""Several volumes that all views determine together: at times of a scan of a sample that changes, or of materials."""

from recon.base.registry import MethodEntry

METHODS = {
    "series": MethodEntry("recon.features.joint.methods", "TimeSeries", compared=False, several="times"),
}

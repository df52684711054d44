"""Reconstruction with a reference: a careful scan of the same sample helps to reconstruct later, faster scans of it."""

from recon.base.registry import MethodEntry

METHODS = {
    "from-reference": MethodEntry("recon.features.reference.methods", "FromReference", compared=False, reference=True),
}

"""Methods of what a sample emits: the activity of highest Poisson likelihood."""

from __future__ import annotations

from recon.base.method_entry import MethodEntry

METHODS = {
    "mlem": MethodEntry("recon.features.emission.methods", "Mlem", compared=False, emission=True),
    "osem": MethodEntry("recon.features.emission.methods", "Osem", compared=False, emission=True),
}

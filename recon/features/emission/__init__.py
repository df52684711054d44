"""Methods of what a sample emits: the activity of highest Poisson likelihood."""

from __future__ import annotations

from recon.base.registry import Lengths, MethodEntry

METHODS = {
    "mlem": MethodEntry(
        "recon.features.emission.methods",
        "Mlem",
        compared=False,
        emission=True,
        lengths=Lengths("iterations", (12, 50), (4, 12, 24, 50, 200), chosen=True),
    ),
    "osem": MethodEntry(
        "recon.features.emission.methods",
        "Osem",
        compared=False,
        emission=True,
        lengths=Lengths("iterations", (3, 12), (1, 3, 6, 12, 50), chosen=True),
    ),
}

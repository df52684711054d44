"""Discrete tomography with partial voxels: a prior of few materials, where views held out prefer it."""

from recon.base.registry import Lengths, MethodEntry

METHODS = {
    "discrete": MethodEntry(
        "recon.features.discrete.methods", "Discrete", lengths=Lengths("iterations", (16, 8), (16, 8))
    )
}
CANDIDATES = {"discrete": 1.5}
PULLS = METHODS

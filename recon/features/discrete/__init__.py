"""Discrete tomography with partial voxels: used if held-out projections show that it is better."""

from recon.base.registry import Lengths, MethodEntry

METHODS = {
    "discrete": MethodEntry(
        "recon.features.discrete.methods", "Discrete", lengths=Lengths("iterations", (60, 10), (60, 10))
    )
}
CANDIDATES = {"discrete": 1.5}
PULLS = METHODS

"""Classical iterative methods for comparison: SIRT, SART, CGLS and ASD-POCS."""

from recon.base.registry import Lengths, MethodEntry

METHODS = {
    "sirt": MethodEntry(
        "recon.features.iterative.methods", "Sirt", lengths=Lengths("iterations", (60, 20), (100, 10, 30, 300))
    ),
    "sart": MethodEntry(
        "recon.features.iterative.methods", "Sart", lengths=Lengths("iterations", (6, 2), (10, 1, 3, 30))
    ),
    "cgls": MethodEntry(
        "recon.features.iterative.methods", "Cgls", lengths=Lengths("iterations", (15, 5), (20, 5, 10, 40))
    ),
    "asd-pocs": MethodEntry(
        "recon.features.iterative.methods", "AsdPocs", lengths=Lengths("iterations", (10,), (20, 5, 50))
    ),
}

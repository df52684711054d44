"""The published R²-Gaussian fit (`r2-published`). Trade-offs leave it out, because its 30 000 steps take long."""

from recon.base.registry import Lengths, MethodEntry

METHODS = {
    "r2-published": MethodEntry(
        "recon.features.published.r2_published",
        "R2Published",
        streams=True,
        compared=False,
        lengths=Lengths("steps", (1000,), (3000, 10_000)),
    ),
}

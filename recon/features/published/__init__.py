"""R²-Gaussian as published, beside our own. Its 30 000 steps would take a trade-off hours."""

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

"""R²-Gaussian as published, beside our own."""

from __future__ import annotations

from recon.base.method_entry import MethodEntry

METHODS = {
    "r2-published": MethodEntry("recon.features.published.r2_published", "R2Published", streams=True, compared=False),
}

"""Neural fields: a volume as a network of the coordinates, fitted to line integrals along sampled rays."""

from __future__ import annotations

from recon.base.method_entry import MethodEntry

METHODS = {
    "naf": MethodEntry("recon.features.neural.methods", "NAF", compared=False),
    "intratomo": MethodEntry("recon.features.neural.methods", "IntraTomo", compared=False),
    "sax-nerf": MethodEntry("recon.features.neural.methods", "SaxNerf", compared=False),
}

OPERATIONS = {"field": "recon.features.neural.speed"}

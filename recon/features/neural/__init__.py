"""Neural fields: a volume as a network of the coordinates, fitted to line integrals along sampled rays."""

from __future__ import annotations

from recon.base.registry import Lengths, MethodEntry

_LENGTHS = Lengths("steps", (300,), (1000, 3000))
METHODS = {
    "naf": MethodEntry("recon.features.neural.methods", "NAF", compared=False, lengths=_LENGTHS),
    "intratomo": MethodEntry("recon.features.neural.methods", "IntraTomo", compared=False, lengths=_LENGTHS),
    "sax-nerf": MethodEntry("recon.features.neural.methods", "SaxNerf", compared=False, lengths=_LENGTHS),
}

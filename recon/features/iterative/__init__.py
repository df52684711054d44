"""Iterative methods that others are compared with: SIRT, SART, CGLS and ASD-POCS."""

from __future__ import annotations

from recon.base.method_entry import MethodEntry

METHODS = {
    "sirt": MethodEntry("recon.features.iterative.sirt", "Sirt"),
    "sart": MethodEntry("recon.features.iterative.sart", "Sart"),
    "cgls": MethodEntry("recon.features.iterative.cgls", "Cgls"),
    "asd-pocs": MethodEntry("recon.features.iterative.asd_pocs", "AsdPocs"),
}

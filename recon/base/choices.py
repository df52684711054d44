"""Choices and figures that options name: apart from what computes, so that a command's help loads neither."""

from __future__ import annotations

from typing import Literal

from recon.base.kernel import Kernel

AUTO = "auto"
"""Name of the choice among methods, `recon.Auto`."""

Filter = Literal["ram-lak", "shepp-logan", "hann"]
Loss = Literal["l1", "l2", "poisson"]
Noise = Literal["auto", "log", "counts"]
Quality = Literal["preview", "standard", "best"]
Rings = Literal["none", "auto", "sort", "vo", "wavelet"]
FlatFields = Literal["groups", "dynamic"]
Start = Literal["fbp", "tv", "published"]

KERNEL = Kernel.COMPACT
"""Of a fit's Gaussians."""

DEFAULT_STEPS = 400
"""Steps of a fit that a finish on voxels follows."""

SHORT_STEPS = 200
"""Steps where the noise of the views hides what more would gain."""

NECK = 0.8
"""Two parts are one particle where the neck between them is at least so wide as the narrower part, as a share."""

N_GAUSSIANS, SIDE = 50_000, 256
"""Of the standard case of `recon.bench`: Gaussians, and rows and columns of a view."""

FEW_PHOTONS = 100
"""In a pixel of the open beam: below, counts are better than their logarithm (docs/notes/exploration.md)."""

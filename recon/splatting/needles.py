"""needles: Gaussians that are thinner than a pixel and much longer, which fit the noise of few views."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.base.geometry import Geometry
from recon.splatting.gaussians import Gaussians

LIMIT = 0.2  # Share of the mass above which needles are told, see docs/published.md

_THIN, _LONG = 0.5, 10.0  # pixels of a standard deviation that views do not resolve; longest over shortest width


@dataclass(frozen=True)
class Needles:
    """Gaussians beyond what the views resolve.

    Attributes:
        thin: share of the mass in Gaussians with a width below half a pixel.
        share: of the mass in those that are ten times as long, too.
        aspect: median of longest over shortest width, each Gaussian counted by its mass.
    """

    thin: float
    share: float
    aspect: float


def needles(gaussians: Gaussians, geometry: Geometry) -> Needles:
    """Shares by mass, density times the three widths; widths are standard deviations."""
    values = gaussians.physical()
    widths = np.sort(values["widths"].astype(np.float64), axis=1)
    mass = values["densities"] * widths.prod(axis=1)
    mass = mass / max(float(mass.sum()), 1e-300)
    aspect = widths[:, 2] / widths[:, 0]
    thin = widths[:, 0] < _THIN * geometry.sample_pitch
    order = np.argsort(aspect)
    middle = min(int(np.searchsorted(np.cumsum(mass[order]), 0.5)), order.size - 1)
    return Needles(float(mass[thin].sum()), float(mass[thin & (aspect > _LONG)].sum()), float(aspect[order[middle]]))

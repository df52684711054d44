"""How a ray meets Gaussians: where a Gaussian ends, and what it adds to a ray."""

from __future__ import annotations

import math
from dataclasses import dataclass

from recon.base.geometry import Geometry


@dataclass(frozen=True)
class Truncation:
    """Where a Gaussian ends.

    Attributes:
        sigmas: at the latest after so many standard deviations (3.5 leaves 0.2 % of a projected one outside).
        faint: and where it has fallen below this fraction of the density unit (times the field for a projection).
    """

    sigmas: float = 3.5
    faint: float = 1e-5

    def __post_init__(self) -> None:
        if not self.sigmas > 0:
            raise ValueError(f"sigmas must be above 0 (inf: never), got {self.sigmas}")
        if not 0 <= self.faint < math.inf:
            raise ValueError(f"faint must be finite and 0 or more, got {self.faint}")


@dataclass(frozen=True)
class RayModel:
    """What a Gaussian gives a ray.

    Attributes:
        exact_above: in a cone, Gaussians whose affine footprint is off by more than this (an estimate of the relative
            L2 error, see `footprints_cpu`) are integrated exactly along each ray; inf: none, 0: all. A parallel
            beam's footprints are exact.
        rectified: False gives the footprints of 3DGS without their correction (Zha et al. 2024, section 4.2), as
            X-Gaussian has them: the density times one length for all, half the width of the field, however much of a
            ray lies in the Gaussian. Kept to show the bias.
    """

    exact_above: float = math.inf
    rectified: bool = True

    def __post_init__(self) -> None:
        if not self.exact_above >= 0:
            raise ValueError(f"exact_above must be a relative error >= 0 (inf: never), got {self.exact_above}")
        if not self.rectified and self.exact_above < math.inf:
            raise ValueError("an exact integral is rectified: leave exact_above at inf where rectified is False")

    def length(self, geometry: Geometry) -> float:
        """mm that stand in for a ray's length in a Gaussian; 0 where the true one is taken."""
        return 0.0 if self.rectified else geometry.detector_shape[1] * geometry.sample_pitch / 2

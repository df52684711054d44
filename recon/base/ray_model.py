"""Truncation and RayModel: where a Gaussian is cut off, and its line integral along a ray."""

from __future__ import annotations

import math
from dataclasses import dataclass

from recon.base.geometry import Geometry


@dataclass(frozen=True)
class Truncation:
    """Where a Gaussian is cut off: at the smaller of two distances from its centre.

    Attributes:
        sigmas: number of standard deviations (3.5 leaves 0.2 % of a projected Gaussian outside).
        faint: fraction of the density unit (times the field of view for a projection) below which it is cut off.
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
    """How the line integral of a Gaussian along a ray is computed.

    Attributes:
        exact_above: in a cone, Gaussians with a larger error of the affine footprint are integrated exactly along each
            ray. The error is relative L2, estimated, see recon.kernels.cpu.footprints. inf: none, 0: all. The
            footprints of a parallel beam are exact.
        rectified: False gives the uncorrected footprints of 3DGS, as in X-Gaussian (see Zha et al. 2024, section 4.2).
            The weight is then density times one length for all, half the width of the field, whatever length of the ray
            lies in the Gaussian. It serves to show the bias.
    """

    exact_above: float = math.inf
    rectified: bool = True

    def __post_init__(self) -> None:
        if not self.exact_above >= 0:
            raise ValueError(f"exact_above must be a relative error >= 0 (inf: never), got {self.exact_above}")
        if not self.rectified and self.exact_above < math.inf:
            raise ValueError(
                "rectified=False needs exact_above=inf, because exact integrals are always rectified; "
                f"got {self.exact_above}"
            )

    def length(self, geometry: Geometry) -> float:
        """mm used for the length of every ray in a Gaussian; 0 to use the true length.

        Raises:
            ValueError: the uncorrected factor for rays with a width, which would not keep a Gaussian's mass.
        """
        if self.rectified:
            return 0.0
        if geometry.width:
            raise ValueError(f"rays with a width ({geometry.width}) need the corrected factor: leave rectified at True")
        return geometry.detector_shape[1] * geometry.sample_pitch / 2

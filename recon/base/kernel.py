"""Kernel, Truncation and RayModel: profile of the Gaussians, where it is cut off, and its integral along a ray."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from recon.base.geometry import Geometry


class Kernel(StrEnum):
    """Profile f(q) of the squared distance q from the centre, in standard deviations; f(0) = 1.

        gaussian       exp(-q / 2)
        compact:1.5    (1 - q / R²)₊^m,   m = 3/2,   R² = 2 m + 5

    R gives the compact kernel the second moment of the Gaussian, so that a covariance means the same with both. Its
    line integral is of the same form with exponent m + 1/2, a polynomial at m = 3/2. Nothing has to be truncated. ∫ (1
    - t² - s²)₊^m ds = √π Γ(m + 1) / Γ(m + 3/2) (1 - t²)₊^(m + 1/2). Its shadow is steeper at the edge and has no tail,
    which suits matter with sharp edges.
    """

    GAUSSIAN = "gaussian"
    COMPACT = "compact:1.5"

    @classmethod
    def _missing_(cls, value: object) -> Kernel:
        raise ValueError(f"kernel must be one of {', '.join(cls)}, got {value!r}")

    @classmethod
    def of_exponent(cls, exponent: float) -> Kernel:
        """The kernel of this exponent, infinite for a Gaussian, as files hold it.

        Raises:
            ValueError: no kernel has this exponent.
        """
        for kernel in cls:
            if kernel.exponent == exponent:
                return kernel
        known = ", ".join(f"{kernel.exponent:g} ({kernel})" for kernel in cls)
        raise ValueError(
            f"unknown kernel exponent {exponent:g}; known exponents are {known}. A newer version of splatline may "
            "have written it"
        )

    @property
    def is_compact(self) -> bool:
        return self is Kernel.COMPACT

    @property
    def exponent(self) -> float:
        """Exponent m of a compact kernel; infinite for a Gaussian, which is its limit."""
        return 1.5 if self.is_compact else math.inf

    @property
    def radius(self) -> float:
        """Radius R at which the kernel ends, in standard deviations."""
        return math.sqrt(2 * self.exponent + 5)

    @property
    def length(self) -> float:
        """Integral along a line through the centre, in standard deviations."""
        if not self.is_compact:
            return math.sqrt(2 * math.pi)
        m = self.exponent
        return self.radius * math.sqrt(math.pi) * math.gamma(m + 1) / math.gamma(m + 1.5)

    @property
    def affine_terms(self) -> tuple[float, float, float, float]:
        """Factors of βᵀΣ₂β, αᵀΣ₂β, αᵀΣ₂α and η² in the error of an affine footprint, see `cpu.footprints`."""
        return (2 / 3, 4 / 3, 10 / 3, 256 / 21) if self.is_compact else (1 / 2, 1.0, 3 / 2, 6.0)

    def reach(self, sigmas: float) -> float:
        """Radius in standard deviations at which it is cut off: a Gaussian at `sigmas`, a compact kernel at its end."""
        return self.radius if self.is_compact else sigmas


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
                "rectified=False needs exact_above=inf, because exact integrals are always rectified; got "
                f"exact_above={self.exact_above}"
            )

    def length(self, geometry: Geometry) -> float:
        """mm used for the length of every ray in a Gaussian; 0 to use the true length.

        Raises:
            ValueError: the uncorrected factor for rays with a width, which would not keep a Gaussian's mass.
        """
        if self.rectified:
            return 0.0
        if geometry.width:
            raise ValueError(f"rays with a width ({geometry.width}) need the corrected factor: leave rectified=True")
        return geometry.detector_shape[1] * geometry.sample_pitch / 2

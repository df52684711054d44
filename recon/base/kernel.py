"""Kernel, Truncation and RayModel: the profile of a Gaussian, where it is cut off, and its integral along a ray."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from recon.base.geometry import Geometry


class Kernel(StrEnum):
    """Profile f(q) of a Gaussian; q is the square of the distance from the centre in standard deviations, f(0) = 1.

    The kernel `gaussian` is f(q) = exp(-q / 2). The kernel `compact:1.5` is f(q) = (1 - q / R²)₊^m with m = 3/2 and R²
    = 2 m + 5. The radius R gives the kernels `compact:1.5` and `gaussian` the same second moment, so a covariance
    describes the same width for both kernels.

    The line integral of the compact kernel is a kernel of the same form, with the exponent m + 1/2 instead of m. For m
    = 3/2 the line integral is a polynomial: ∫ (1 - t² - s²)₊^m ds = √π Γ(m + 1) / Γ(m + 3/2) (1 - t²)₊^(m + 1/2). The
    compact kernel ends at a finite radius, while a Gaussian kernel must be cut off. The projection of the compact
    kernel is steeper at its edge than that of a Gaussian, and has no tail. The compact kernel suits samples with sharp
    edges.
    """

    GAUSSIAN = "gaussian"
    COMPACT = "compact:1.5"

    @classmethod
    def _missing_(cls, value: object) -> Kernel:
        raise ValueError(f"kernel must be one of {', '.join(cls)}, got {value!r}")

    @classmethod
    def of_exponent(cls, exponent: float) -> Kernel:
        """The kernel with the exponent `exponent` (infinite for a Gaussian), as files store it.

        Raises:
            ValueError: there is no kernel with the exponent `exponent`.
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
        """Exponent m of a compact kernel; infinite for a Gaussian, which is the limit of compact kernels."""
        return 1.5 if self.is_compact else math.inf

    @property
    def radius(self) -> float:
        """Radius R, in standard deviations, at which the kernel ends."""
        return math.sqrt(2 * self.exponent + 5)

    @property
    def length(self) -> float:
        """Integral of the profile along a line through the centre; the unit of length is a standard deviation."""
        if not self.is_compact:
            return math.sqrt(2 * math.pi)
        m = self.exponent
        return self.radius * math.sqrt(math.pi) * math.gamma(m + 1) / math.gamma(m + 1.5)

    @property
    def affine_terms(self) -> tuple[float, float, float, float]:
        """Factors of the terms βᵀΣ₂β, αᵀΣ₂β, αᵀΣ₂α and η² in the error of an affine footprint; `kernels.cpu.footprints`
        defines these terms."""
        return (2 / 3, 4 / 3, 10 / 3, 256 / 21) if self.is_compact else (1 / 2, 1.0, 3 / 2, 6.0)

    def reach(self, sigmas: float) -> float:
        """Radius in standard deviations beyond which the kernel is 0: `sigmas` for a Gaussian, which is cut off."""
        return self.radius if self.is_compact else sigmas


@dataclass(frozen=True)
class Truncation:
    """Rule for the distance from its centre at which a Gaussian is cut off: the smaller of two distances.

    Attributes:
        sigmas: number of standard deviations (with 3.5, 0.2 % of a projected Gaussian is outside).
        faint: fraction of the density unit below which the Gaussian is cut off. In a projection, the limit is this
            fraction times the density unit times the width of the field of view.
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
        exact_above: limit for cone beams. If the error of the affine footprint of a Gaussian is larger, the Gaussian is
            integrated exactly along each ray. The error is an estimated relative L2 error, see
            recon.kernels.cpu.footprints. inf: no Gaussian is integrated exactly; 0: all are. In a parallel beam, all
            footprints are exact.
        rectified: False gives the uncorrected footprints of 3DGS, as in X-Gaussian (see Zha et al. 2024, section 4.2).
            The weight of a Gaussian is then its density times half the width of the field of view, whatever the length
            of the ray in the Gaussian. Use False only to demonstrate the bias.
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
        """Length in mm that replaces the length of a ray in a Gaussian; 0: the true length is used.

        Raises:
            ValueError: the rays have a width and `rectified` is False. Then the mass of a Gaussian would not be
                conserved.
        """
        if self.rectified:
            return 0.0
        if geometry.width:
            raise ValueError(
                "leave rectified=True: without the corrected footprints, a Gaussian does not keep its mass if rays "
                f"have a width ({geometry.width})"
            )
        return geometry.detector_shape[1] * geometry.sample_pitch / 2

"""Kernel: the radial profile of the model's Gaussians, a true Gaussian or one with compact support."""

from __future__ import annotations

import math
from enum import StrEnum


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
        raise ValueError(f"no kernel has exponent {exponent:g}; known are {known}. A newer version may have written it")

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

"""Error model: how the error of a volume falls with more projections, and the expected improvement in PSNR (dB).

The mean square error of a volume from n projections has three parts, given as shares of it. `offset` is a constant
error in the middle of the volume. It comes from unknown density outside the field of view, and only laterally offset
projections reduce it. `noise` falls with the number of photons, also at the same angles. The remaining share comes from
gaps between the angles. With projections at new angles, the last two parts together fall as n^-exponent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

BELOW = 0.5
"""For the low end of a gain's range, exponent and noise share are lowered by at most this share of themselves.

For the high end they may be raised by more. The value is a convention.
"""


@dataclass(frozen=True)
class Gain:
    """A predicted improvement in PSNR (dB) and its range (docs/performance.md says how often the range holds)."""

    mean: float
    low: float
    high: float

    @property
    def at_most(self) -> float:
        """The gain to assume before further projections are given up.

        It is the mean, or the high end if the exponent is uncertain by half or more.
        """
        return self.mean if self.high <= (1 + BELOW) * self.mean * (1 + 1e-9) else self.high


@dataclass(frozen=True)
class ErrorLaw:
    """Error model of a volume from `n_views` projections, measured without ground truth; see the module.

    Attributes:
        n_views: number of projections of the volume.
        exponent: exponent with which the mean square error falls with the number of projections.
        exponent_error: uncertainty of the exponent, which gives the range of a gain. The exponent is assumed to lie
            within twice this value, but not below half of the exponent. Both shares are assumed to have the same
            relative uncertainty. See `recon.voxels.measured_law`.
        noise, offset: shares of the mean square error, each 0 to 1.
    """

    n_views: int
    exponent: float
    exponent_error: float
    noise: float
    offset: float = 0.0

    def gain(self, views: int = 0, again: int = 0, wide: bool = False) -> Gain:
        """Improvement in PSNR (dB) from more projections.

        Args:
            views: number of projections at new angles.
            again: number of repeated projections at the same angles.
            wide: also laterally offset projections.
        """

        def decibels(factor: float) -> float:  # with the exponent and the shares multiplied by this factor
            noise = min(factor * self.noise, 1 - self.offset)
            offset = self.offset * (max(1 - factor, 0) if wide else 1)
            gaps_and_noise = 1 - noise - self.offset + noise * self.n_views / (self.n_views + again)
            error_ratio = gaps_and_noise * (1 + views / self.n_views) ** (-factor * self.exponent) + offset
            return -10 * math.log10(error_ratio) or 0.0  # never -0.0

        above = min(2 * self.exponent_error / self.exponent, 1.0) if self.exponent else 1.0
        return Gain(decibels(1.0), decibels(1 - min(above, BELOW)), decibels(1 + above))

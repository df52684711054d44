"""Error model: how the error of a volume falls with more projections, and the expected improvement in PSNR (dB).

The mean square error of a volume from n projections has three parts, given as shares of it. `offset` is a constant
error in the middle of the volume. The cause of this offset is unknown density outside the field of view. Only laterally
offset projections reduce the offset. `noise` falls with the number of photons, also at the same angles. The third part,
which is the rest, comes from the gaps between the angles. With projections at new angles, the sum of the second and the
third part falls as n^-exponent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

BELOW = 0.5
"""Limits the range of a predicted gain: for its low end, exponent and noise share are lowered by at most this fraction.

For the high end, exponent and noise share may be raised by more. The value is a convention; it was not measured.
"""


@dataclass(frozen=True)
class Gain:
    """A predicted improvement in PSNR (dB) and its range (docs/performance.md says how often the range holds)."""

    mean: float
    low: float
    high: float

    @property
    def at_most(self) -> float:
        """The gain (dB) to compare with the wanted gain before a scan decides against further projections.

        It is the mean gain. If the uncertainty of the exponent is half of the exponent or more, it is the high end of
        the range.
        """
        return self.mean if self.high <= (1 + BELOW) * self.mean * (1 + 1e-9) else self.high


@dataclass(frozen=True)
class ErrorLaw:
    """Error model of a volume from `n_views` projections, measured without ground truth. The docstring of the module
    defines the model.

    Attributes:
        n_views: number of projections of the volume.
        exponent: exponent with which the mean square error falls with the number of projections.
        exponent_error: uncertainty of the exponent, from which the range of a gain is computed. The range assumes that
            the exponent is wrong by at most twice this uncertainty, and is not below half of its value. It also assumes
            that both shares have the same relative uncertainty. See `recon.voxels.measured_law`.
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

        def decibels(factor: float) -> float:  # the gain if the exponent and the shares are multiplied by this factor
            noise = min(factor * self.noise, 1 - self.offset)
            offset = self.offset * (max(1 - factor, 0) if wide else 1)
            gaps_and_noise = 1 - noise - self.offset + noise * self.n_views / (self.n_views + again)
            error_ratio = gaps_and_noise * (1 + views / self.n_views) ** (-factor * self.exponent) + offset
            return -10 * math.log10(error_ratio) or 0.0  # never -0.0

        relative_error = min(2 * self.exponent_error / self.exponent, 1.0) if self.exponent else 1.0
        return Gain(decibels(1.0), decibels(1 - min(relative_error, BELOW)), decibels(1 + relative_error))

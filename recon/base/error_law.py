"""Error law: how the error of a volume falls with further views, and the gain in dB that follows for each kind.

The mean square error of a volume of n views has three parts, which are stated as shares of it. `offset` is a constant
in the middle of the volume, by an unknown density beside the field, and falls only with offset views. `noise` falls
with the light, also at the same angles. The third part, the remaining share, is by gaps between the angles. The last
two together fall as n^-exponent with views at new angles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

BELOW = 0.5
"""Over the mean: a gain is taken to lie so far below it, at most, and beyond it where a law is known. A convention."""


@dataclass(frozen=True)
class Gain:
    """A predicted gain in dB of PSNR, and the ends of its range (docs/performance.md says how often they hold)."""

    mean: float
    low: float
    high: float

    @property
    def at_most(self) -> float:
        """The gain to assume before it is given up: the mean, or the high end if the law is unsure by half or more."""
        return self.mean if self.high <= (1 + BELOW) * self.mean * (1 + 1e-9) else self.high


@dataclass(frozen=True)
class ErrorLaw:
    """The error of a volume of `n_views`, as measured without a truth; see the module.

    Attributes:
        n_views: of the volume.
        exponent: of the fall of the mean square error with the number of views.
        exponent_error: the exponent is taken to lie within twice this, though not below half of itself, and both shares
            within the same part of themselves, which gives the range of a gain. See `recon.voxels.measured_law`.
        noise, offset: shares of the mean square error, each 0 to 1.
    """

    n_views: int
    exponent: float
    exponent_error: float
    noise: float
    offset: float = 0.0

    def gain(self, views: int = 0, again: int = 0, wide: bool = False) -> Gain:
        """Gain in dB of PSNR by further views: at new angles, at the same angles again, and by offset views."""

        def decibels(factor: float) -> float:  # with the exponent and the shares times this factor
            noise = min(factor * self.noise, 1 - self.offset)
            offset = self.offset * (max(1 - factor, 0) if wide else 1)
            gaps_and_noise = 1 - noise - self.offset + noise * self.n_views / (self.n_views + again)
            error_ratio = gaps_and_noise * (1 + views / self.n_views) ** (-factor * self.exponent) + offset
            return -10 * math.log10(error_ratio) or 0.0  # never -0.0

        above = min(2 * self.exponent_error / self.exponent, 1.0) if self.exponent else 1.0
        return Gain(decibels(1.0), decibels(1 - min(above, BELOW)), decibels(1 + above))

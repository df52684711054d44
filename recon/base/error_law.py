"""Error law: how the error of a volume falls with further views, and the gain in dB that follows for each kind.

The mean square error of a volume of n views has three shares: `offset`, an unknown density beside the field that adds
a constant in the middle and falls only with wide views; `noise`, which falls with the light, at the same angles too;
and the rest, by gaps between the angles. The last two together fall as n^-exponent when views at new angles come.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Gain:
    """A predicted gain in dB of PSNR, and the ends of its range (docs/performance.md says how often they hold)."""

    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class ErrorLaw:
    """The error of a volume of `n_views`, as measured without a truth; see the module.

    Attributes:
        n_views: of the volume.
        exponent: of the fall of the mean square error with the number of views.
        exponent_error: its standard error; those of the shares are as large a part of them.
        noise, offset: shares of the mean square error, each 0 to 1.
    """

    n_views: int
    exponent: float
    exponent_error: float
    noise: float
    offset: float = 0.0

    def gain(self, views: int = 0, again: int = 0, wide: bool = False) -> Gain:
        """dB by so many views at new angles, at the same angles again, and by wide views."""

        def of(scale: float) -> float:
            noise = min(scale * self.noise, 1 - self.offset)
            beside = self.offset * (max(1 - scale, 0) if wide else 1)
            light = noise * self.n_views / (self.n_views + again)
            left = (1 - noise - self.offset + light) * (1 + views / self.n_views) ** (-scale * self.exponent)
            return -10 * math.log10(left + beside) or 0.0  # never -0.0

        error = min(2 * self.exponent_error / self.exponent, 1.0) if self.exponent else 1.0
        return Gain(of(1.0), of(1 - error), of(1 + error))

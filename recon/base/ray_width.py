"""RayWidth: the rays that a pixel averages during one exposure, beside its central ray."""

from __future__ import annotations

from dataclasses import dataclass, replace

from recon.base.declared_types import Checked
from recon.base.setting import NonNegative


@dataclass(frozen=True)
class RayWidth(Checked):
    """Spread of a pixel's signal on the detector, and turn of the stage during the exposure; 0: a single ray.

    Attributes:
        pixel: side in pixels of the square over which a pixel averages; 1: its own area.
        blur: standard deviation in pixels of a Gaussian blur of the detector (scintillator, optics).
        arc: radians that the stage turns during an exposure; a view's angle is that of the middle of its exposure.
    """

    pixel: NonNegative = 0.0
    blur: NonNegative = 0.0
    arc: NonNegative = 0.0

    def __bool__(self) -> bool:
        return self.variance > 0 or self.arc > 0

    @property
    def variance(self) -> float:
        """Variance of the spread along columns, and along rows, in px²."""
        return self.pixel**2 / 12 + self.blur**2

    def binned(self, factor: int) -> RayWidth:
        """The same in pixels of factor x factor; a pixel's own area becomes that of the binned one."""
        return replace(self, blur=self.blur / factor)


NO_WIDTH = RayWidth()

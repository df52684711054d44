"""RayWidth: the bundle of rays around its central ray over which a pixel averages during one exposure."""

from __future__ import annotations

from dataclasses import dataclass, replace

from recon.base.declared_types import Checked
from recon.base.setting import NonNegative


@dataclass(frozen=True)
class RayWidth(Checked):
    """The causes that make a ray wide: the area over which a pixel averages, the blur, and the rotation during the
    exposure. If `pixel`, `blur` and `arc` are all 0, a ray is a line.

    Attributes:
        pixel: side of the square over which the detector averages, divided by the pixel size; 1: the area of a pixel.
        blur: standard deviation in pixels of a Gaussian blur of the detector (scintillator, optics).
        arc: angle in radians by which the stage turns during an exposure. The angle of a projection is the angle at the
            middle of its exposure.
    """

    pixel: NonNegative = 0.0
    blur: NonNegative = 0.0
    arc: NonNegative = 0.0

    def __bool__(self) -> bool:
        return self.variance > 0 or self.arc > 0

    @property
    def variance(self) -> float:
        """Variance of a ray in px², from the area of the pixel and the blur. The variance along columns is equal to the
        variance along rows."""
        return self.pixel**2 / 12 + self.blur**2

    def binned(self, factor: int) -> RayWidth:
        """The same width after binning by factor x factor. The area over which a pixel averages becomes the area of the
        binned pixel."""
        return replace(self, blur=self.blur / factor)


NO_WIDTH = RayWidth()

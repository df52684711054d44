"""Scatter: photons that the sample deflects arrive elsewhere, and stray light arrives everywhere."""

from __future__ import annotations

from dataclasses import dataclass

from simulators.effects.chain import ImageEffect
from simulators.frame.mapping import NotNegative, Positive
from simulators.frame.shot import Image, Shot
from simulators.pixels.broad_blur import add_enlarged, broad_blur, gaussian


@dataclass(frozen=True)
class Scatter(ImageEffect):
    """Adds ratio x the mean or a broad blur of the transmitted image, and a constant background.

    The ratio compares scattered with primary photons (Siewerdsen & Jaffray 2001, Med. Phys. 28:220). A flat has the
    background, but no scatter. Name it before the effects of the scintillator.

    Attributes:
        ratio: scattered photons over transmitted ones, both as means over the frame.
        width_mm: standard deviation of the Gaussian by which the scattered image is blurred, mm at the sample; None:
            evenly spread. The frame's edges are mirrors.
        background: photons/s on an unbinned sensor pixel; p x photons_per_s is a share p of the open beam.
    """

    ratio: NotNegative = 0.0
    width_mm: Positive | None = None
    background: NotNegative = 0.0

    def apply(self, image: Image, shot: Shot) -> Image:
        level = self.background * shot.exposure * shot.binning**2
        if self.ratio > 0 and shot.sample:
            if self.width_mm is None:
                level += self.ratio * float(image.mean())
            else:
                add_enlarged(image, broad_blur(image, self.width_mm / shot.detector.pitch, gaussian), self.ratio)
        if level > 0:
            image += level
        return image

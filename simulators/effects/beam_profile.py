"""Beam profile: the beam is brightest in the middle, striped, and wanders, so that flats are uneven and age."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simulators.effects.chain import ImageEffect
from simulators.frame.mapping import BelowOne, Positive
from simulators.frame.shot import Image, Shot


@dataclass(frozen=True)
class BeamProfile(ImageEffect):
    """A Gaussian of 1 in its middle times horizontal stripes, as a multilayer monochromator leaves them.

    The middle of the beam, stripes and all, is at centre + wander_speed t + wander sin(2 pi t / wander_period), t in s
    since the camera was connected. The wander does not shift the image: the beam moves, the sample and the scintillator
    do not. Within an exposure the beam is constant.

    Attributes:
        sigma: (horizontal, vertical) in mm.
        stripes: amplitude of the stripes, as a share of the beam.
        stripe_period: mm, vertically.
        drift: mm/s, speed of the stripes down the rows within the beam.
        centre: (horizontal, vertical) in mm from the rotation axis and z = 0.
        wander_speed: (horizontal, vertical) in mm/s.
        wander: amplitude (horizontal, vertical) in mm.
        wander_period: s.
    """

    sigma: tuple[Positive, Positive]
    stripes: BelowOne = 0.0
    stripe_period: Positive = 0.1
    drift: float = 0.0
    centre: tuple[float, float] = (0.0, 0.0)
    wander_speed: tuple[float, float] = (0.0, 0.0)
    wander: tuple[float, float] = (0.0, 0.0)
    wander_period: Positive = 60.0

    def apply(self, image: Image, shot: Shot) -> Image:
        middle = self.middle(shot.elapsed)
        u, v = shot.detector.u() - middle[0], shot.detector.v() - middle[1]
        across = np.exp(-0.5 * (u / self.sigma[0]) ** 2)
        phase = 2 * np.pi * (v - self.drift * shot.elapsed) / self.stripe_period
        down = np.exp(-0.5 * (v / self.sigma[1]) ** 2) * (1 + self.stripes * np.sin(phase))
        image *= down[:, None]
        image *= across
        return image

    def middle(self, elapsed: float) -> tuple[float, float]:
        """Where the middle of the beam is (horizontal, vertical), mm, `elapsed` s after the camera was connected."""
        swing = np.sin(2 * np.pi * elapsed / self.wander_period)
        horizontal, vertical = (
            centre + speed * elapsed + amplitude * swing
            for centre, speed, amplitude in zip(self.centre, self.wander_speed, self.wander, strict=True)
        )
        return float(horizontal), float(vertical)

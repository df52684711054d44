"""Effects of an exposure: the sample rotates during it, a pixel has an area, and the beam is uneven and drifts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from recon.base.setting import setting
from simulators.effects.chain import AreaEffect, ImageEffect, SamplingEffect
from simulators.frame.mapping import BelowOne, Positive
from simulators.frame.shot import Image, Moments, Shot

LOOKS = 5  # number of times within the exposure at which the stage's angle is read, so that a reversal counts as motion


@dataclass(frozen=True)
class MotionBlur(SamplingEffect):
    """Mean of the transmission over times within the exposure; the number of times depends on the blur (at rest: 1).

    The moments are spread evenly (midpoint rule). Gauss-Legendre rules of as many points are not better, since the
    transmission jumps at edges. A battery with 1 px of blur and 1, 2, 4, 8 moments has errors of 1.1, 0.38, 0.13,
    0.045 in 1000 of the beam (rms).

    Attributes:
        tolerance_px: pixels that the sample's rim may travel from one moment to the next. The rim counts even if it
        lies outside the frame: in front of the axis and behind it, it crosses the middle of the frame.
        max_samples: largest number of moments; each costs a frame's line integrals.
    """

    tolerance_px: Positive = 0.5
    max_samples: int = setting(16, ge=2)

    def moments(self, moments: Moments, shot: Shot) -> Moments:
        n = self.samples(shot)
        if n == 0:
            return moments
        within = ((np.arange(n) + 0.5) / n - 0.5) * shot.exposure  # time from the middle of the exposure
        times = (within[:, None, None] + moments.times).reshape(-1, moments.times.shape[1])
        return Moments(times, np.tile(moments.weights / n, n))

    def samples(self, shot: Shot) -> int:
        """Number of moments; 0 if the stage stands while the first row is exposed."""
        angles = [shot.angle_at(shot.time + shot.exposure * k / (LOOKS - 1)) for k in range(LOOKS)]
        turned = sum(abs(later - earlier) for earlier, later in pairwise(angles))
        rim, sod = shot.radius / shot.detector.pitch, shot.detector.sod  # travel of the rim, pixels per radian
        if not math.isinf(sod):
            rim /= max(1 - shot.radius / sod, 0.05)  # the rim on the side towards the source
        return math.ceil(min(turned * rim / self.tolerance_px, self.max_samples))


@dataclass(frozen=True)
class PixelArea(AreaEffect):
    """Mean of the transmission over rays x rays points of a pixel, evenly spread (midpoint rule).

    Without this effect, edges are as sharp as a single ray and jump from pixel to pixel. No volume of voxels can
    explain such projections, and iterative methods change their volumes to fit them (docs/studies.md).

    Attributes:
        rays: number of rays along each side of the pixel, 2 ... 8; each of the rays² rays needs the line integrals of a
            frame.
    """

    rays: int = setting(2, ge=2, le=8)

    @property
    def offsets(self) -> tuple[tuple[float, float], ...]:
        steps = [(k + 0.5) / self.rays - 0.5 for k in range(self.rays)]
        return tuple((row, col) for row in steps for col in steps)


@dataclass(frozen=True)
class BeamProfile(ImageEffect):
    """A Gaussian of 1 in its middle times horizontal stripes, as a multilayer monochromator leaves them.

    The middle of the beam, with its stripes, is at centre + wander_speed t + wander sin(2 pi t / wander_period), t in s
    since the camera was connected. The wander does not shift the image: the beam moves, the sample and the scintillator
    do not. Within an exposure the beam is constant.

    Attributes:
        sigma: (horizontal, vertical) in mm.
        stripes: amplitude of the stripes, as a share of the beam.
        stripe_period: vertical period of the stripes in mm. drift: speed of the stripes down the rows within the beam,
            mm/s. centre: position (horizontal, vertical) in mm from the rotation axis and z = 0. wander_speed: speed
            (horizontal, vertical) in mm/s. wander: amplitude (horizontal, vertical) in mm. wander_period: period in s.
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
        """Position (horizontal, vertical) of the beam's middle in mm, `elapsed` s after the camera was connected."""
        swing = np.sin(2 * np.pi * elapsed / self.wander_period)
        horizontal, vertical = (
            centre + speed * elapsed + amplitude * swing
            for centre, speed, amplitude in zip(self.centre, self.wander_speed, self.wander, strict=True)
        )
        return float(horizontal), float(vertical)
